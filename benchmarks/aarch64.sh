#!/bin/sh
# Compare the boxes of 8-bit models on emulated ARM processors with those of this x86 computer.
#
#     benchmarks/aarch64.sh FOLDER [FRAMES [MODEL ...]]
#
# Needs root and, on Debian, debootstrap and qemu-user-static 8.1 or later (bookworm-backports). Older ones show programs
# the /proc/cpuinfo of the host, and onnxruntime crashes at import. FOLDER gets a Debian for arm64 and aarch64 wheels of
# all dependencies, which are used again, and the record of this computer. Nothing is installed outside FOLDER.
# cortex-a72 (Raspberry Pi 4) has no dot product, cortex-a76 (Raspberry Pi 5) has it, max has matrix products too.
# Emulation takes seconds a frame, so FRAMES is 60 at most. Its speed says nothing about the processors.
set -eu
if [ $# -lt 1 ]; then
    sed -n '4s/^# *//p' "$0" >&2
    exit 2
fi
source=$(cd "$(dirname "$0")/.." && pwd)
mkdir -p "$1"
folder=$(cd "$1" && pwd) frames=${2:-60}
[ $# -lt 2 ] || shift
shift
[ $# -gt 0 ] || set -- psiamfcpp-alexnet-n-int8 plightfc-int8

if [ ! -d "$folder/root/usr" ]; then
    debootstrap --arch=arm64 --variant=minbase --include=python3 --download-only bookworm "$folder/packages"
    for package in "$folder"/packages/var/cache/apt/archives/*.deb; do
        dpkg-deb -x "$package" "$folder/root"
    done
fi
if [ ! -d "$folder/env" ]; then
    # Debian's Python is 3.11. Wheels for another computer are only unpacked.
    python3 -m pip install --quiet --target "$folder/env" --only-binary=:all: --python-version 3.11 \
        --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 --platform manylinux2014_aarch64 \
        --constraint "$source/constraints.txt" joblib numpy onnxruntime opencv-python-headless rich tyro
fi
# Anew each time, since models may have changed.
PYTHONPATH="$source/src" python3 "$source/benchmarks/processors.py" record "$folder/here.npz" --models "$@"

status=0
for processor in cortex-a72 cortex-a76 max; do
    PYTHONPATH="$source/src:$folder/env" qemu-aarch64-static -cpu "$processor" -L "$folder/root" \
        "$folder/root/usr/bin/python3" "$source/benchmarks/processors.py" compare "$folder/here.npz" \
        --frames "$frames" --models "$@" || status=1
done
exit $status
