"""The learner's side of the replay servers: the draws and the priorities, over sockets."""
