"""`psiamfcpp bench`."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import notes, print_json, watching
from psiamfcpp.recipes.bench import BenchResult
from psiamfcpp.recipes.bench import bench as time_all


def bench(
    models: tuple[str, ...] = (),
    engines: tuple[str, ...] = (),
    devices: tuple[str, ...] = (),
    threads: int | None = None,
    rounds: int = 5,
    frames: int = 30,
    sequence: Path | None = None,
    tracker: tuple[str, ...] = ("opencv:mil",),
    json: Json = False,
) -> None:
    """Time models on engines and devices, and peers, in turn in one process: whole updates, and where their time goes.

    Args:
        models: shipped models, checkpoints or folders of graphs; by default all that are shipped.
        engines: what to run them on, where it can; by default all that are installed.
        devices: cpu, cuda or tensorrt; by default cpu, and cuda where the installed torch or onnxruntime has it.
        threads: threads of every engine; by default all cores.
        rounds: how often each is timed.
        frames: updates a round.
        sequence: folder with img/ and groundtruth_rect.txt to follow; by default a rendered 720p clip.
        tracker: others to time beside them, as opencv:mil, opencv:nano,backbone=FILE,neckhead=FILE or dcf:kcf.
    """
    with watching() as watch:
        result = time_all(models, engines, devices, threads, rounds, frames, sequence, tracker, watch)
    noise = result.facts["noise"]
    if result.facts["noisy"]:
        notes.print(f"the machine was busy: a fixed piece of work took {noise:.0%} longer than at its fastest")
    if json:
        print_json({"rows": result.rows, "processors": result.processors, **result.facts})
    else:
        _print(result)


def _print(result: BenchResult) -> None:
    facts = result.facts
    print(f"{facts['cpu']}, {facts['threads']} threads, {' '.join(facts['flags'])}")
    print(f"frames of {facts['frame_size'][0]}x{facts['frame_size'][1]}; decoding one takes {facts['read_ms']:.1f} ms")
    titles = f"{'ms':>7} {'+-':>5} {'min':>6} {'crop':>5} {'graph':>6} {'decode':>6} speedup"
    print(f"{'model':26} {'engine':9} {'device':8} {'':5} {titles}")
    for row in result.rows:
        gain = f"{row['speedup']:.2f}x" if row["speedup"] else ""
        print(
            f"{row['model']:26} {row['engine']:9} {row['device'] or '':8} {row['precision'] or '':5} "
            f"{row['ms_median']:7.2f} {row['ms_spread']:5.2f} {row['ms_min']:6.2f} {row['crop_ms']:5.2f} "
            f"{row['graph_ms']:6.2f} {row['decode_ms']:6.2f} {gain}"
        )
    print(f"\nframes per second on the fastest engine\n{'model':26} {'CPU':>12} {'GPU':>12}")
    for row in result.processors:
        shown = ["not measured" if row[key] is None else f"{row[key]:.1f}" for key in ("fps_cpu", "fps_gpu")]
        print(f"{row['model']:26} {shown[0]:>12} {shown[1]:>12}")
