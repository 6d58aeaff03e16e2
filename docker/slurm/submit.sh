#!/bin/sh
# Puts a training into Slurm's queue, or changes its number of actors:
#
#   docker/slurm/submit.sh start  --run DIR --config cluster.toml --actors 64 [-- sbatch flags for all jobs]
#   docker/slurm/submit.sh grow   --run DIR --config cluster.toml --from 64 --actors 32     actors 64 to 95
#   docker/slurm/submit.sh shrink --run DIR --from 64                                       ends actors 64 and above
#   docker/slurm/submit.sh stop   --run DIR                                                 the learner saves and ends for good
#
# DIR is on a disk that all nodes share. Job numbers go to DIR/slurm-jobs, one per line: `learner 17`, `actors 18 0 63`.
# CAUDATA_BIN: folder of the executables (default: target/release of this checkout). CAUDATA_RUN_ID: default `salamander`.
# CAUDATA_LEARNER_ARGS, CAUDATA_ACTOR_ARGS: more flags for sbatch, for instance "--gres=gpu:1 --cpus-per-task=8".
# CAUDATA_PKI: folder of the certificates' authority, on the shared disk; default DIR/pki, an authority of this run alone, made here.
#   Each start of the learner's job issues its certificate for the host that it was given, and the actors' where there is none.
# CAUDATA_SCHEME=tcp and CAUDATA_HOST=127.0.0.1 keep everything on one host without certificates.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
usage() { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 64; }
[ $# -gt 0 ] || usage
what=$1
shift
run= config= actors= from=0
while [ $# -gt 0 ]; do
    case $1 in
        --run) run=$2; shift 2 ;;
        --config) config=$2; shift 2 ;;
        --actors) actors=$2; shift 2 ;;
        --from) from=$2; shift 2 ;;
        --) shift; break ;;
        *) echo "submit.sh: unknown word $1" >&2; usage ;;
    esac
done
[ -n "$run" ] || usage
mkdir -p "$run/logs"
CAUDATA_RUN=$(cd "$run" && pwd)
CAUDATA_BIN=${CAUDATA_BIN:-$(cd "$here/../.." && pwd)/target/release}
CAUDATA_RUN_ID=${CAUDATA_RUN_ID:-salamander}
jobs=$CAUDATA_RUN/slurm-jobs
if [ -n "$config" ]; then
    CAUDATA_CONFIG=$(cd "$(dirname "$config")" && pwd)/$(basename "$config")
    export CAUDATA_CONFIG
fi
CAUDATA_PKI=${CAUDATA_PKI:-$CAUDATA_RUN/pki}
export CAUDATA_RUN CAUDATA_BIN CAUDATA_RUN_ID CAUDATA_PKI

array() { # FIRST COUNT, then sbatch flags
    first=$1
    last=$(($1 + $2 - 1))
    shift 2
    # shellcheck disable=SC2086
    job=$(sbatch --parsable --array="$first-$last" --output="$CAUDATA_RUN/logs/actor-%a.log" ${CAUDATA_ACTOR_ARGS:-} "$@" "$here/actors.sbatch")
    echo "actors $job $first $last" >> "$jobs"
    echo "actors $first to $last are job $job"
}

case $what in
    start)
        [ -n "$config" ] && [ -n "$actors" ] || usage
        rm -f "$CAUDATA_RUN/stop" "$CAUDATA_RUN/address"
        if [ "${CAUDATA_SCHEME:-quic}" = quic ] && [ ! -e "$CAUDATA_PKI/ca.key" ]; then
            "$CAUDATA_BIN/caudata" pki init --dir "$CAUDATA_PKI" --lab "$CAUDATA_RUN_ID"
        fi
        # shellcheck disable=SC2086
        job=$(sbatch --parsable --output="$CAUDATA_RUN/logs/learner.log" ${CAUDATA_LEARNER_ARGS:-} "$@" "$here/learner.sbatch")
        echo "learner $job" >> "$jobs"
        echo "the learner is job $job"
        array "$from" "$actors" "$@"
        ;;
    grow)
        [ -n "$config" ] && [ -n "$actors" ] || usage
        array "$from" "$actors" "$@"
        ;;
    shrink)
        grep '^actors ' "$jobs" | while read -r _ job first last; do
            id=$first
            while [ "$id" -le "$last" ]; do
                [ "$id" -lt "$from" ] || echo "${job}_$id"
                id=$((id + 1))
            done
        done | xargs -r scancel --batch --signal=TERM
        ;;
    stop)
        # Tells the learner's job not to go back into the queue; the learner itself tells the actors to end.
        : > "$CAUDATA_RUN/stop"
        sed -n 's/^learner //p' "$jobs" | xargs -r scancel --batch --signal=TERM
        ;;
    *) usage ;;
esac
