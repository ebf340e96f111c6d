#!/bin/sh
# Workers of a fleet as a Slurm array, without a queue: task I of N does every N-th view and cell, then what others left.
# usage: sbatch --array=0-15 encoder/deploy/slurm.sh BUCKET [flags of `slag-encoder worker`]
#   BUCKET: a folder that all nodes see, or s3://BUCKET/PREFIX with credentials in the environment.
# Start `slag-encoder encode ... --blobs BUCKET` where the photos are, before or after; tasks that Slurm starts again
# (--requeue) find finished work in the bucket.
#SBATCH --job-name=slag-worker
#SBATCH --cpus-per-task=2
#SBATCH --requeue
set -eu
[ $# -ge 1 ] || { echo "usage: sbatch --array=0-15 $0 BUCKET [flags of slag-encoder worker]" >&2; exit 2; }
bucket=$1
shift
exec "${SLAG_ENCODER:-slag-encoder}" worker --blobs "$bucket" \
    --index "$SLURM_ARRAY_TASK_ID" --of "$SLURM_ARRAY_TASK_COUNT" \
    --threads "${SLURM_CPUS_PER_TASK:-1}" "$@"
