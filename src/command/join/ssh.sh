#!/bin/bash
# Actors on hosts that ssh reaches, for a run of this host that listens:
#
#   shoal train pendulum --run runs/ssh --listen
#
# Shoal must be installed on each of them. The key goes through ssh and is not kept there. The script ends when
# the run is over.
set -euo pipefail

run=${RUN:-runs/ssh}
hosts=${HOSTS:-node-1 node-2}    # as ssh knows them
actors=${ACTORS:-4}              # on each

endpoint=$(sed -n 's/^endpoint = "\(.*\)"$/\1/p' "$run/join.toml")
for host in $hosts; do
  ssh "$host" shoal join "$endpoint" --key - --actors "$actors" < "$run/join.key" &
done
wait
