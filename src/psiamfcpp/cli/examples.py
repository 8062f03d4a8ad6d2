"""Examples that a command's help ends with, and the groups in which commands are listed."""

from __future__ import annotations

GROUPS: dict[str, tuple[str, ...]] = {
    "follow": ("demo", "track", "serve"),
    "compare": ("evaluate", "score", "report", "reproduce", "trackers", "datasets", "trax", "bench"),
    "make models": ("train", "rank", "plan", "prune", "sensitivity", "calibrate", "export", "import", "info"),
}

EXAMPLES: dict[str, tuple[str, ...]] = {
    "demo": ("psiamfcpp demo", "psiamfcpp demo --model psiamfcpp-alexnet-s-int8 -o small.mp4"),
    "track": (
        "psiamfcpp track flight.mp4 --output followed.mp4",
        "psiamfcpp track flight.mp4 --start 1:30 --box 618,329,53,46 --boxes boxes.csv",
        "psiamfcpp track rtsp://CAMERA/STREAM --tracker opencv:mil",
    ),
    "serve": ("psiamfcpp serve demo", "psiamfcpp serve rtsp://CAMERA/STREAM --fov 70 --record recordings"),
    "evaluate": (
        "psiamfcpp evaluate --root SEQUENCES --results results",
        "psiamfcpp evaluate --dataset dtb70 --root DTB70 --tracker psiamfcpp-alexnet-int8 opencv:mil --plain",
    ),
    "score": ("psiamfcpp score --dataset dtb70 --annotations LABELS --results TRACKERS",),
    "report": ("psiamfcpp report results -o report",),
    "reproduce": ("psiamfcpp reproduce", "psiamfcpp reproduce --root BENCHMARKS --dry-run"),
    "trackers": ("psiamfcpp trackers", "psiamfcpp trackers --json"),
    "datasets": ("psiamfcpp datasets --root BENCHMARKS",),
    "trax": ("psiamfcpp trax --model psiamfcpp-alexnet-int8 --plain",),
    "bench": ("psiamfcpp bench", "psiamfcpp bench --threads 2 --models psiamfcpp-alexnet-s-int8"),
    "train": (
        "psiamfcpp train --data stills:PHOTOS clips:CLIPS --init START.safetensors -o runs/first",
        "psiamfcpp train --data clips:CLIPS --init pruned.safetensors --teacher siamfcpp-alexnet -o runs/tuned",
    ),
    "rank": ("psiamfcpp rank siamfcpp-alexnet --data stills:PHOTOS clips:CLIPS -o ranks.json --images 200",),
    "plan": (
        "psiamfcpp plan ranks.json --preset paper -o plan.json",
        "psiamfcpp plan ranks.json --target-macs 0.3 -o plan.json",
    ),
    "prune": ("psiamfcpp prune siamfcpp-alexnet --plan plan.json --data clips:CLIPS -o pruned.safetensors",),
    "sensitivity": ("psiamfcpp sensitivity siamfcpp-alexnet --ranks ranks.json --root SEQUENCES -o runs/sensitivity",),
    "calibrate": ("psiamfcpp calibrate MODEL --data CLIPS -o calibrated.safetensors",),
    "export": ("psiamfcpp export siamfcpp-alexnet -o graphs --int8 --data clips:CLIPS",),
    "import": (
        "psiamfcpp import OFFICIAL.pkl -o official.safetensors",
        "psiamfcpp import TEMPLATE.onnx TRACK.onnx -o lightfc.safetensors",
    ),
    "info": ("psiamfcpp info siamfcpp-alexnet", "psiamfcpp info opencv:mil"),
}


def examples(command: str) -> str:
    """Return the end of a command's help."""
    return "\n".join(["examples:", *(f"  {line}" for line in EXAMPLES[command])])
