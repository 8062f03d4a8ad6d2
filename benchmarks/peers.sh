#!/bin/sh
# Evaluate and time OpenCV's trackers, with KCF and CSRT of the contrib wheel.
#
#     benchmarks/peers.sh SEQUENCES NANO_BACKBONE.onnx NANO_HEAD.onnx [FOLDER [THREADS]]
#
# Prints precision and AUC on a folder of sequences, then milliseconds of one update on THREADS threads (2), beside
# the smallest model of ours. The contrib wheel holds the same package cv2 as the wheel that psiamfcpp depends on, and
# they overwrite each other. So FOLDER, a temporary one by default, gets an environment of its own. Results are kept in
# FOLDER too: a run that was stopped goes on there.
set -eu
if [ $# -lt 3 ]; then
    sed -n '4s/^# *//p' "$0" >&2
    exit 2
fi
source=$(dirname "$0")/..
sequences=$1 nano="opencv:nano,backbone=$2,neckhead=$3" folder=${4:-$(mktemp -d)} threads=${5:-2}
opencv=$(sed -n 's/^opencv-python-headless==//p' "$source/constraints.txt")

[ -d "$folder/env" ] || python3 -m venv "$folder/env"
# What psiamfcpp depends on, but for OpenCV; then psiamfcpp alone.
"$folder/env/bin/pip" install --quiet --constraint "$source/constraints.txt" \
    joblib numpy onnxruntime rich tyro "opencv-contrib-python-headless==$opencv"
"$folder/env/bin/pip" install --quiet --no-deps "$source"

set -- opencv:kcf opencv:csrt opencv:mil "$nano"
"$folder/env/bin/psiamfcpp" evaluate --root "$sequences" --threads 1 --results "$folder/results" --tracker "$@"
"$folder/env/bin/psiamfcpp" bench --threads "$threads" --models psiamfcpp-alexnet-n-int8 --tracker "$@"
