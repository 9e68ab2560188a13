#!/bin/bash
# A run with actors on many nodes, for Slurm. Save this as shoal.sh, then:
#
#   LEARNER=$(sbatch --parsable shoal.sh learner)
#   sbatch --array=1-16 --dependency=after:$LEARNER shoal.sh actors
#
# The learner is one job, and each node with actors another: a node that fails or is preempted ends nothing but its own
# actors, and the array may be of any size. Jobs that are requeued continue.
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=8
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --signal=B:TERM@60
set -euo pipefail

what=pendulum                    # a preset, gym:ID or a configuration file
run=${RUN:-$PWD/runs/slurm}      # on a file system that all nodes see

case ${1:-} in
  learner)
    if [ -f "$run/config.toml" ]; then
      exec shoal resume "$run" --listen --hosts-wait --quiet
    fi
    exec shoal train "$what" --run "$run" --listen --hosts-wait --set actors.max=256 --quiet
    ;;
  actors)
    # The learner's job may start later than this one.
    for _ in $(seq 600); do
      [ -f "$run/join.key" ] && break
      sleep 1
    done
    exec shoal join "$run" --actors "${SLURM_CPUS_PER_TASK:-1}" --give-up 10min
    ;;
  *)
    echo "usage: shoal.sh learner|actors" >&2
    exit 2
    ;;
esac
