"""What every role speaks: agent, window, messages, bus. Imports none of the roles."""
