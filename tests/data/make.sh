#!/bin/bash
# Makes and packs the run directories that later versions must be able to read.
#
#   tests/data/make.sh SHOAL OUT
#
# SHOAL is the absolute path of the program, OUT a directory for the archives. The runs are made in the working
# directory. The gym: runs need a python3 with the package in python/ installed.
set -euo pipefail
shoal=$1 out=$2

train() {
    local name=$1
    shift
    "$shoal" train --run "$name" --quiet --json --set replay.capacity=5000 --set actors.max=4 \
        --set evaluation.every=500 --set evaluation.episodes=2 --set evaluation.final_episodes=2 "$@"
}
# A small network that begins to learn early.
ddpg=(--set 'ddpg.hidden=[8,8]' --set ddpg.batch=8 --set replay.warmup=64)
# Many updates per step, so that the run takes long; frequent checkpoints, so that it has two of them.
slow=(--set replay.updates_per_step=8 --set checkpoint.every_seconds=0.2 --set checkpoint.every_updates=200)

# Waits until a run has both checkpoints, a best policy, and a row in learner.csv.
wait_until_saved() {
    until [ -e "$1/checkpoints/previous.ckpt" ] && [ -e "$1/checkpoints/best.policy" ] &&
        [ "$(wc -l <"$1/learner.csv")" -gt 1 ]; do
        sleep 0.02
    done
}

train free-finished point-mass-r3 --steps 1500 "${ddpg[@]}" --set replay.updates_per_step=64
train lockstep-finished frozen-lake --steps 5000 --set q-learning.epsilon=0.9 --set evaluation.episodes=20 \
    --set evaluation.keep_policies=true
train gym-finished gym:CartPole-v1 --steps 1500 --set 'reinforce.hidden=[8,8]'

train free-stopped pendulum --steps 60000 "${ddpg[@]}" "${slow[@]}" &
wait_until_saved free-stopped
"$shoal" scale free-stopped --actors 3
kill -9 "$(sed -n 's/^actor-0 .*started as process //p' free-stopped/shoal.log)"
until grep -q started-again free-stopped/incidents.csv; do sleep 0.02; done
"$shoal" stop free-stopped
wait

train lockstep-stopped pendulum --lockstep --steps 15000 "${ddpg[@]}" "${slow[@]}" &
wait_until_saved lockstep-stopped
"$shoal" stop lockstep-stopped
wait

train gym-stopped gym:Pendulum-v1 --steps 10000 "${ddpg[@]}" "${slow[@]}" &
wait_until_saved gym-stopped
"$shoal" stop gym-stopped
wait

# The figures are left out: `shoal plot` makes them again.
for run in {free,lockstep,gym}-{finished,stopped}; do
    tar --create --sort=name --owner=0 --group=0 --numeric-owner --exclude='*.svg' "$run" | gzip -9n >"$out/$run.tar.gz"
done
