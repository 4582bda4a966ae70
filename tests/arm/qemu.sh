#!/bin/sh
# Run aarch64 Python with the packages of setup.sh. Usage: CPU=cortex-a76 qemu.sh FOLDER ARGUMENTS...
set -eu
folder=$1
shift
exec "$folder/root/usr/bin/qemu-aarch64-static" -L "$folder/root" \
    -E PYTHONHOME="$folder/root/usr" -E PYTHONPATH="$folder/site:$PWD" \
    -E NUMBA_CPU_NAME="${CPU:-cortex-a76}" -E NUMBA_CPU_FEATURES=+neon -E NUMBA_NUM_THREADS=1 \
    -E NUMBA_CACHE_DIR="$folder/cache" -E ERTIS_CACHE_DIR="$folder/costs" \
    "$folder/root/usr/bin/python3.11" "$@"
