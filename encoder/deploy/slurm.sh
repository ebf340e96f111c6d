#!/bin/sh
# Workers of a fleet as a Slurm array, without a queue: task I of N does every N-th view, then what others left.
# usage: sbatch --array=0-15 encoder/deploy/slurm.sh BUCKET [flags of `slag-encoder worker`]
#   BUCKET: a folder that all nodes see, or s3://BUCKET/PREFIX with credentials in the environment.
# Start `slag-encoder encode ... --blobs BUCKET` where the photos are, before or after, and `scancel --name
# slag-worker` once it has ended; tasks that Slurm starts again (--requeue) find finished work in the bucket.
# Where fewer tasks run at a time than the array has, give `--help-after 5`: those that run do the others'
# shares then, instead of waiting for them.
#SBATCH --job-name=slag-worker
#SBATCH --cpus-per-task=2
#SBATCH --requeue
set -eu
[ $# -ge 1 ] || { echo "usage: sbatch --array=0-15 $0 BUCKET [flags of slag-encoder worker]" >&2; exit 2; }
bucket=$1
shift
# Arrays may begin at another number than 0.
exec "${SLAG_ENCODER:-slag-encoder}" worker --blobs "$bucket" \
    --index "$((SLURM_ARRAY_TASK_ID - SLURM_ARRAY_TASK_MIN))" --of "$SLURM_ARRAY_TASK_COUNT" \
    --threads "${SLURM_CPUS_PER_TASK:-1}" "$@"
