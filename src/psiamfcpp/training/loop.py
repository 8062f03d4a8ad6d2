"""The training loop: resumable to the step, on one process or many."""

from __future__ import annotations

import contextlib
import copy
import ctypes
import dataclasses
import io
import json
import math
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.frames import FrameStore
from psiamfcpp.errors import UserError
from psiamfcpp.files import check_file, read_text, write_whole, writing
from psiamfcpp.machine import has_bf16
from psiamfcpp.models.arch import opened
from psiamfcpp.models.checkpoint import save
from psiamfcpp.models.network import Network
from psiamfcpp.training.asked import Ask, open_asked
from psiamfcpp.training.batches import Batch, numbered_batches
from psiamfcpp.training.objective import Objective
from psiamfcpp.training.options import LossWeights, RunOptions, TeacherOptions, TrainOptions
from psiamfcpp.training.pairs import PairSampler
from psiamfcpp.training.stored import StoredMaps
from psiamfcpp.training.teacher import Teacher, answer, feature_loss, open_teacher
from psiamfcpp.training.validation import held_out_batches, pair_score

STATE_FILE = "state.pt"
LOG_FILE = "log.jsonl"
MODEL_FILE = "model.safetensors"
_ALONE = TeacherOptions()


class PairLoss(nn.Module):
    """The network with its losses in one forward pass, which is the form that DDP wraps."""

    def __init__(
        self,
        model: Network,
        weights: LossWeights,
        teacher: Teacher | None = None,
        taught: TeacherOptions = _ALONE,
    ):
        super().__init__()
        self.model = model
        self._objective: Objective = opened(model.spec.arch.objective)
        self._weights = weights
        self._teacher = teacher
        self._taught = taught

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The losses of a batch."""
        found = answer(self.model, batch)
        parts = self._objective.labelled(found.maps, batch, self._weights)
        if self._teacher:
            wanted = self._teacher(batch)
            parts["teacher"] = self._objective.taught(found.maps, wanted.maps, batch)
            parts["total"] = parts["total"] + self._taught.teacher_weight * parts["teacher"]
            if self._taught.teacher_features:
                parts["features"] = feature_loss(found, wanted)
                parts["total"] = parts["total"] + self._taught.teacher_features * parts["features"]
        if batch.said is not None and self._objective.stored:
            parts["stored"] = self._objective.stored(found.maps, batch)
            parts["total"] = parts["total"] + self._taught.stored_weight * parts["stored"]
        return parts


def train(
    model: Network,
    training: list[Sequence],
    held_out: list[Sequence],
    output: Path,
    options: TrainOptions,
    run: RunOptions,
) -> Iterator[dict[str, Any]]:
    """Train a network, or continue the run found in ``output``.

    Writes ``model.safetensors`` (the mean weights), ``state.pt`` (all that resuming needs) and ``log.jsonl``. Under
    ``torchrun`` every process takes its share of each step's pairs and the first one writes.

    Args:
        model: the network to train, in place.
        training: sequences that pairs are drawn from.
        held_out: sequences of the validation pairs; may be empty.
        output: folder of the run.
        options: what decides the result; a resumed run must have the same.
        run: what does not.

    Yields:
        Each row of the log, as it is written.

    Raises:
        UserError: the folder holds a run with other options, or cannot be written, or the teacher cannot be read.
    """
    _keep_freed_memory()
    rank, ranks = _join_processes()
    device = (
        torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if torch.cuda.is_available() else torch.device("cpu")
    )
    model.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    arch = model.spec.arch
    if options.teacher.stored and opened(arch.objective).stored is None:
        raise UserError(
            f"a model of architecture {model.spec.architecture} cannot learn from stored maps: use --teacher"
        )
    teacher = None
    if options.teacher.teacher:
        teacher = open_teacher(options.teacher.teacher, device, model.spec.architecture)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"run folder {output} cannot be made: {error}") from None
    optimizer = _optimizer(model, options)
    mean = copy.deepcopy(model)
    start = _resume(output / STATE_FILE, model, mean, optimizer, options) or run.first_step
    if run.compile:
        # The parts and not the losses, which are made anew whenever another set of layers is free.
        for part in model.children():
            part.compile()
    stored, ask = _stored(options, device)
    if ranks > 1 and options.schedule.low_every > 1:
        raise UserError("low-every needs one process: under torchrun, leave it at 1")
    if rank == 0:
        _truncate_log(output / LOG_FILE, start)

    store = FrameStore(Path(run.frames) if run.frames else output / "frames")
    sampler = PairSampler(training, options.pairs, options.seed, int(run.cache_gb * 1e9), store, arch)
    validation = (
        held_out_batches(held_out, options.pairs, run.validation_pairs, options.batch, store, arch)
        if held_out and rank == 0
        else []
    )
    module: nn.Module  # made at the first step, as `free` is not a set of layers before
    free: frozenset[str] | None = None
    bf16 = run.bf16 and bf16_pays(device)
    began = clock = time.perf_counter()
    count, sums = 0, dict[str, Tensor]()
    steps = options.schedule.steps
    for step, batch in enumerate(
        numbered_batches(sampler, options.batch, start, steps, rank, ranks, run.workers, stored), start=start
    ):
        if options.schedule.free(step) != free:
            free = options.schedule.free(step)
            module = _thaw(model, free, options, teacher, ranks)
        for group in optimizer.param_groups:
            group["lr"] = options.schedule.rate(step) * group["factor"]
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            moved = batch.to(device)
            parts = module(ask(moved) if ask else moved)
        parts["total"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), options.clip)
        optimizer.step()
        optimizer.zero_grad()
        _follow(mean, model, min(options.ema, (step + 1) / (step + 10)) if options.ema else 0.0)
        count += 1
        for name, value in parts.items():
            # On the device: a float at every step would make the GPU wait for this process.
            sums[name] = sums.get(name, 0) + value.detach().double()

        done = step + 1
        over = _over(began, run.max_time, device, ranks)
        if rank == 0 and (done % 50 == 0 or done == steps or over):
            row: dict[str, Any] = {name: float(total) / count for name, total in sums.items()}
            row |= {
                "step": done,
                "lr": options.schedule.rate(step),
                "pairs_per_s": count * options.batch * ranks / (time.perf_counter() - clock),
            }
            if validation and (done % run.validate_every == 0 or done == steps):
                row["validation"] = dataclasses.asdict(pair_score(mean, validation, bf16))
            clock, count, sums = time.perf_counter(), 0, {}
            with writing(output / LOG_FILE), (output / LOG_FILE).open("a") as log:
                log.write(json.dumps(row) + "\n")
            yield row
        if rank == 0 and (done % run.save_every == 0 or done == steps or over):
            _save(output, model, mean, optimizer, done, options)
        if over:
            break
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()


def _stored(options: TrainOptions, device: torch.device) -> tuple[StoredMaps | None, Ask | None]:
    """What a folder of stored maps or a LightFC says of pairs, whichever the options name."""
    where = options.teacher.stored
    if not where:
        return None, None
    if Path(where).is_dir():
        return StoredMaps(Path(where), options.pairs, options.seed), None
    return None, open_asked(where, device)


def _over(began: float, minutes: float, device: torch.device, ranks: int) -> bool:
    """Whether the time given to a run is over; for every process if for one, or some would wait for others."""
    if minutes == math.inf:
        return False
    over = time.perf_counter() - began > 60 * minutes
    if ranks == 1:
        return over
    anyone = torch.tensor(float(over), device=device)
    dist.all_reduce(anyone, dist.ReduceOp.MAX)
    return bool(anyone)


def bf16_pays(device: torch.device) -> bool:
    """Whether bfloat16 is computed in hardware there; emulated, it is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return has_bf16()


def _keep_freed_memory() -> None:
    """Have glibc keep what is freed: giving every step's large maps back to the kernel, to be zeroed again, is slow."""
    mmap_threshold, trim_threshold = -3, -1
    # Other C libraries have no such setting.
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for parameter in (mmap_threshold, trim_threshold):
            libc.mallopt(parameter, 2**31 - 1)


def _join_processes() -> tuple[int, int]:
    """Rank and number of processes, joined to the others if ``torchrun`` started this one."""
    if "RANK" not in os.environ:
        return 0, 1
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return dist.get_rank(), dist.get_world_size()


def _optimizer(model: Network, options: TrainOptions) -> torch.optim.Optimizer:
    """Weights decay, biases and BatchNorm do not; the backbone's rate is a share of the others'."""
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    backbone = {id(parameter) for parameter in model.backbone.parameters()}
    for name, parameter in model.named_parameters():
        factor = options.schedule.backbone_lr if id(parameter) in backbone else 1.0
        factor *= math.prod(rate for pattern, rate in model.spec.arch.rates if re.fullmatch(pattern, name))
        groups.setdefault((factor, options.weight_decay if parameter.ndim == 4 else 0.0), []).append(parameter)
    listed = [{"params": p, "factor": factor, "weight_decay": decay} for (factor, decay), p in groups.items()]
    if options.optimizer == "sgd":
        return torch.optim.SGD(listed, lr=options.schedule.lr, momentum=0.9)
    return torch.optim.AdamW(listed, lr=options.schedule.lr)


def _thaw(
    model: Network, free: frozenset[str], options: TrainOptions, teacher: Teacher | None, ranks: int
) -> nn.Module:
    """Let gradients into the free backbone layers only; DDP must be wrapped anew when that set changes.

    Layers for which the table names no share of the run are always free. The backbone's BatchNorm keeps its statistics
    throughout: it starts as the identity, and batches are small.
    """
    model.train()
    model.backbone.eval()
    frozen = model.spec.arch.unfreeze.keys() - free
    for name, layer in model.backbone.named_children():
        layer.requires_grad_(name not in frozen)
    loss = PairLoss(model, options.losses, teacher, options.teacher)
    return nn.parallel.DistributedDataParallel(loss) if ranks > 1 else loss


@torch.no_grad()
def _follow(mean: Network, model: Network, decay: float) -> None:
    """Move the mean weights towards the model's."""
    for old, new in zip(mean.state_dict().values(), model.state_dict().values(), strict=True):
        if new.is_floating_point():
            old.lerp_(new, 1 - decay)
        else:
            old.copy_(new)


def _save(
    output: Path,
    model: Network,
    mean: Network,
    optimizer: torch.optim.Optimizer,
    step: int,
    options: TrainOptions,
) -> None:
    state = {
        "step": step,
        "options": json.dumps(dataclasses.asdict(options)),
        "model": model.state_dict(),
        "mean": mean.state_dict(),
        "optimizer": optimizer.state_dict(),
    }
    # The model first: a run killed between the two does these steps again, instead of ending with an old model.
    save(output / MODEL_FILE, mean)
    # In memory first: torch says of a full disk only "iostream error", in a RuntimeError.
    content = io.BytesIO()
    torch.save(state, content)
    write_whole(output / STATE_FILE, content.getbuffer())


def _resume(
    path: Path,
    model: Network,
    mean: Network,
    optimizer: torch.optim.Optimizer,
    options: TrainOptions,
) -> int:
    """Load the saved state, if any, and return the step to continue from."""
    if not path.exists():
        return 0
    check_file(path, "state", "remove it to begin the run anew")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        before, now = _completed(json.loads(state["options"]), TrainOptions()), dataclasses.asdict(options)
        if json.loads(json.dumps(before)) != json.loads(json.dumps(now)):
            raise UserError(f"{path} belongs to a run with other options: use another output folder, or remove it")
        if {k: v.shape for k, v in state["model"].items()} != {k: v.shape for k, v in model.state_dict().items()}:
            raise UserError(f"{path} belongs to a network of other widths: use another output folder, or remove it")
        model.load_state_dict(state["model"])
        mean.load_state_dict(state["mean"])
        optimizer.load_state_dict(state["optimizer"])
        return int(state["step"])
    except UserError:
        raise
    except Exception as error:  # a damaged pickle can fail in any way
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path} cannot be read ({reason}): remove it to begin the run anew") from None


def _completed(stored: Any, default: Any) -> Any:
    """Return stored options over the defaults: a run of an earlier version says nothing of options born later.

    Their defaults must therefore mean what that version did.
    """
    if not dataclasses.is_dataclass(default) or isinstance(default, type):
        return stored
    given = {key: _completed(value, getattr(default, key, None)) for key, value in stored.items()}
    return {**dataclasses.asdict(default), **given}


def _truncate_log(path: Path, step: int) -> None:
    """Drop what a killed run logged after its last saved state, since it will be logged again."""
    if not path.exists():
        return
    rows = [line for line in read_text(path, "training log").splitlines() if _step_of(line) <= step]
    write_whole(path, "".join(row + "\n" for row in rows))


def _step_of(line: str) -> float:
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")
