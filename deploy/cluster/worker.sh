#!/bin/bash
# Keeps Ray on a worker: starts it again within seconds whenever it ends. Ray ends where the head was out of reach for a
# minute, and then waits for its autoscaler, which takes half a minute longer or gives up.
#
#   worker.sh RAY start --address=HEAD:PORT OPTIONS...   start and keep it; changes nothing where it is kept so already
#   worker.sh RAY stop --force                           keep it no longer, and stop it
#
# It is also kept no longer once it could not be started for an hour.
set -u
PATIENCE_SECONDS=3600
STATE=~/.ray/rmc-worker # what keeps Ray locks it; in it are its process and its words

ray=$1 action=$2
shift 2

head_answers() {
  timeout 1 bash -c ": < /dev/tcp/${1%:*}/${1#*:}"
}

keep() { # HEAD:PORT OPTIONS...
  local raylet head=$1 ran_at=$SECONDS
  while ((SECONDS - ran_at < PATIENCE_SECONDS)); do
    raylet=$(pgrep -n -f "^[^ ]*/raylet .*--gcs-address=$head( |$)")
    while kill -0 "$raylet"; do
      ran_at=$SECONDS
      sleep 1
    done
    "$ray" stop --force # what else is left of it
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
"$ray" stop --force 9>&-
[ "$action" = start ] || exit 0
"$ray" start "$@" 9>&- || exit
head=$(grep -oP -m 1 -- '--address=\K\S+' <<< "$*")
trap '' HUP # of the terminal that closes now
setsid "$0" "$ray" keep "$head" "$@" < /dev/null &> "$STATE.log" &
printf '%s\n' $! "$ray $*" > "$STATE"
