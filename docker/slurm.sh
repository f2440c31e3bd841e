#!/usr/bin/env bash
# A run on the nodes of a Slurm job. Activate the Python environment that has es-service, then:
#
#     sbatch docker/slurm.sh configs/cluster/ant_maze_me_es.yaml /shared/runs/first
#     squeue --me                                         # should show the job with state R
#     es-service status /shared/runs/first --follow       # shows that it works: one line per generation
#
# The config, the run folder and the environment are on a disk that all nodes share. Options of `es-service run` may
# follow the run folder. Options of sbatch stand before docker/slurm.sh and replace those below:
#
#     sbatch --nodes=8 --cpus-per-task=64 --time=12:00:00 docker/slurm.sh CONFIG RUN --workers 512
#
# When the job is preempted or reaches its time limit, it goes back to the queue and later resumes the run. After
# `scancel` it does not. The same sbatch command again resumes the run, too.
#
#SBATCH --job-name=es-service
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --time=24:00:00
# Ray is stopped at the end by `ray stop`, which ends every Ray process of the user on a node: share no node.
#SBATCH --exclusive
# A job that lost a node goes on with the others. A job that lost its first node is requeued by Slurm.
#SBATCH --no-kill
#SBATCH --requeue
#SBATCH --open-mode=append
# SIGTERM to this script alone, 90 s before the time limit.
#SBATCH --signal=B:TERM@90
set -u

if [ $# -lt 2 ]; then
    echo "usage: sbatch docker/slurm.sh CONFIG RUN_FOLDER [options of es-service run]" >&2
    exit 2
fi
config=$1 run=$2
shift 2

# Ray's ports are open to the whole network of the nodes, and only those who have the token can use them. Each start of
# the job has its own token, which travels in plain text. The dashboard is open to the first node alone.
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export RAY_AUTH_TOKEN RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
export RAY_SYMMETRIC_RUN_CLUSTER_WAIT_TIMEOUT=300    # seconds that the other nodes wait for the first one

# This script runs on the first node, which becomes the head. The other nodes must reach it at this address: what its
# name means, or its first address if the name means 127.0.1.1, as on Debian.
head=$(hostname --ip-address 2> /dev/null | cut -d' ' -f1)
case $head in
'' | 127.*) head=$(hostname --all-ip-addresses | cut -d' ' -f1) ;;
esac

# `ray symmetric-run` does not pass SIGTERM on, and its exit code is 0 if Ray could not be started. So the driver leaves
# its process id and its exit code here.
state=$(mktemp -d)
trap 'rm -rf "$state"' EXIT
# shellcheck disable=SC2016
driver='trap : TERM
(echo "$BASHPID" > "$0/pid"; exec es-service run "$@")
code=$?
echo "$code" > "$0/code"
exit "$code"'

stop_at=
stop() {
    [ -n "$stop_at" ] && return
    stop_at=$((SECONDS + 60))
    if [ -s "$state/pid" ]; then kill -TERM "$(cat "$state/pid")"; fi    # it finishes the transaction in hand
}
trap stop TERM

srun --cpus-per-task="$SLURM_CPUS_PER_TASK" --no-kill --kill-on-bad-exit=0 \
    ray symmetric-run --address "$head:6379" --num-cpus="$SLURM_CPUS_PER_TASK" --object-store-memory=200000000 \
    --disable-usage-stats -- \
    bash -c "$driver" "$state" "$config" --or-resume --out "$run" --address auto "$@" &
srun=$!

runs() { [ -n "$1" ] && kill -0 "$1" 2> /dev/null; }

wait_for_driver() {
    until [ -s "$state/code" ]; do
        pid=$(cat "$state/pid" 2> /dev/null)
        if ! runs "$srun" && ! runs "$pid"; then break; fi
        if [ -n "$stop_at" ] && { [ -z "$pid" ] || [ "$SECONDS" -ge "$stop_at" ]; }; then break; fi
        sleep 0.2
    done
    code=$(cat "$state/code" 2> /dev/null)
    if [ -z "$code" ] && ! runs "$srun"; then
        wait "$srun"
        if [ $? = 143 ]; then code=143; fi    # SIGTERM to all tasks, as Slurm sends it on preemption
    fi
}
wait_for_driver

# When this script ends, Slurm ends what still runs on the nodes.
if [ "$code" = 143 ] || { [ -z "$code" ] && [ -n "$stop_at" ]; }; then
    # A job that was cancelled is not RUNNING, nor is one that Slurm itself has put back into the queue.
    if [ "$(squeue --noheader --jobs="$SLURM_JOB_ID" --format=%T)" = RUNNING ]; then
        scontrol requeue "$SLURM_JOB_ID" && exit 0
    fi
    exit 143
fi
if [ -z "$code" ]; then
    echo "Ray did not start on the first node, or its task was killed; the reason is above" >&2
    exit 1
fi
exit "$code"
