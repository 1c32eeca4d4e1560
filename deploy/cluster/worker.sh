#!/bin/bash
# Keeps Ray on a worker: starts it again within seconds whenever it ends. Ray ends where the head was out of reach for so
# long that it gave the node up, and then waits for its autoscaler, which takes half a minute or gives up.
#
#   worker.sh RAY start --address=HEAD:PORT OPTIONS...   start and keep it; changes nothing where it is kept so already
#   worker.sh RAY stop --force                           keep it no longer, and stop it
#
# It is also kept no longer once it could not be started for an hour.
set -u
PATIENCE_SECONDS=3600
STOP_SECONDS=5
TRIES=3 # of the first start: on a busy machine Ray's own processes may wait for each other in vain
export RAY_gcs_rpc_server_reconnect_timeout_s=300 # the roles play on meanwhile: longer than the head waits for the node
STATE=~/.ray/rmc-worker # what keeps Ray locks it; in it are its process and its words

ray=$1 action=$2
shift 2

head_answers() {
  timeout 1 bash -c ": < /dev/tcp/${1%:*}/${1#*:}"
}

raylet_of() { # HEAD:PORT
  pgrep -n -f "^[^ ]*/raylet .*--gcs-address=$1( |$)"
}

# The head hears at once from a raylet that ends in order; of one that was killed only once it gives the node up.
leave() { # HEAD:PORT
  local raylet
  raylet=$(raylet_of "$1") && head_answers "$1" && kill "$raylet" || return
  timeout "$STOP_SECONDS" tail --pid="$raylet" -s 0.2 -f /dev/null
}

keep() { # HEAD:PORT OPTIONS...
  local head=$1 ran_at=$SECONDS
  while ((SECONDS - ran_at < PATIENCE_SECONDS)); do
    while raylet_of "$head" > /dev/null; do # not by its number: where nobody reaps it, that stays
      ran_at=$SECONDS
      sleep 1
    done
    pkill -9 -f "^[^ ]*/python[0-9.]* .*--gcs-address=$head( |$)" # what is left of it; ray stop would take seconds
    until head_answers "$head" || ((SECONDS - ran_at >= PATIENCE_SECONDS)); do sleep 0.5; done
    "$ray" start "${@:2}"
  done
}

if [ "$action" = keep ]; then
  keep "$@" 9>&- # Ray would hold the lock, too
  exit
fi
mkdir -p "${STATE%/*}"
exec 9>> "$STATE"
if ! flock -n 9; then
  [ "$action" = start ] && [ "$(tail -n +2 "$STATE")" = "$ray $*" ] && exit
  kill -- "-$(head -n 1 "$STATE")"
  flock -w 10 9 || exit
fi
head=$(grep -oP -m 1 -- '--address=\K\S+' "$STATE") && leave "$head"
for _ in $(seq "$TRIES"); do
  "$ray" stop --force 9>&-
  [ "$action" = start ] || exit 0
  "$ray" start "$@" 9>&- && break
done || exit
head=$(grep -oP -m 1 -- '--address=\K\S+' <<< "$*")
trap '' HUP # of the terminal that closes now
setsid "$0" "$ray" keep "$head" "$@" < /dev/null &> "$STATE.log" &
printf '%s\n' $! "$ray $*" > "$STATE"
