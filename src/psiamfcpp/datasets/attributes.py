"""What makes each sequence of a benchmark hard, from the benchmark's own files: a 0 or 1 for each attribute.

The files do not name their columns. `NAMES` lists the attributes as the benchmarks' papers do, in the order in which
their toolkits are said to store them; a file ``names.txt`` beside the attribute files, one name per line, overrides it.
"""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import read_text

_UAV123 = (
    "scale variation", "aspect ratio change", "low resolution", "fast motion", "full occlusion", "partial occlusion",
    "out of view", "background clutter", "illumination variation", "viewpoint change", "camera motion",
    "similar object",
)  # fmt: skip
NAMES: dict[str, tuple[str, ...]] = {
    # Mueller et al., ECCV 2016
    "uav123-10fps": _UAV123,
    "uav123": _UAV123,
    "uav20l": _UAV123,
    # Li and Yeung, AAAI 2017
    "dtb70": (
        "scale variation", "aspect ratio variation", "occlusion", "deformation", "fast camera motion",
        "in-plane rotation", "out-of-plane rotation", "out of view", "background clutter", "similar objects around",
        "motion blur",
    ),
    # Du et al., ECCV 2018
    "uavdt": (
        "background clutter", "camera rotation", "object rotation", "small object", "illumination variation",
        "object blur", "scale variation", "large occlusion", "long-term tracking",
    ),
    # Wen et al., ECCVW 2018
    "visdrone2018": (
        "aspect ratio change", "background clutter", "camera motion", "fast motion", "full occlusion",
        "illumination variation", "low resolution", "out of view", "partial occlusion", "similar object",
        "scale variation", "viewpoint change",
    ),
    # Wu et al., TPAMI 2015
    "otb100": (
        "illumination variation", "out-of-plane rotation", "scale variation", "occlusion", "deformation",
        "motion blur", "fast motion", "in-plane rotation", "out of view", "background clutter", "low resolution",
    ),
}  # fmt: skip
_PLACES: dict[str, tuple[str, ...]] = {
    # the sequences at 10 frames a second are those of UAV123
    "uav123-10fps": ("anno/UAV123_10fps/att/{}.txt", "anno/UAV123/att/{}.txt"),
    "uav123": ("anno/UAV123/att/{}.txt",),
    "uav20l": ("anno/UAV20L/att/{}.txt",),
    "dtb70": ("att/{}.txt", "anno/att/{}.txt"),
    "uavdt": ("anno/{}_att.txt", "att/{}_att.txt", "{}_att.txt"),
    "visdrone2018": ("attributes/{}_attr.txt",),
    "otb100": ("anno/att/{}.txt", "att/{}.txt"),
}


def read_attributes(dataset: str, root: Path, sequences: list[str]) -> dict[str, list[str]]:
    """The sequences that have each attribute, by the attribute's name.

    Args:
        dataset: name of the benchmark.
        root: its folder, in the official layout.
        sequences: names of its sequences.

    Returns:
        Return one entry per attribute; nothing where no file of attributes is there.

    Raises:
        UserError: a sequence has no file where others have, or a file holds anything but a 0 or 1 an attribute.
    """
    for place in _PLACES.get(dataset, ()):
        files = {name: root / place.format(name) for name in sequences}
        if not any(path.is_file() for path in files.values()):
            continue
        columns = _columns(dataset, next(iter(files.values())).parent)
        found: dict[str, list[str]] = {name: [] for name in columns}
        for sequence, path in files.items():
            for name, flag in zip(columns, _read(path, len(columns)), strict=True):
                if flag:
                    found[name].append(sequence)
        return found
    return {}


def _columns(dataset: str, folder: Path) -> tuple[str, ...]:
    names = folder / "names.txt"
    if not names.is_file():
        return NAMES[dataset]
    given = tuple(line.strip() for line in read_text(names, "attribute names").splitlines() if line.strip())
    if len(set(given)) != len(given):
        raise UserError(f"{names} holds a name twice: one name per column is needed")
    return given


def _read(path: Path, columns: int) -> list[bool]:
    fix = f"{columns} numbers, each 0 or 1, are expected; a names.txt beside it names other columns"
    text = read_text(path, "attributes", fix)
    try:
        flags = [float(word) for word in text.replace(",", " ").split()]
        if len(flags) != columns or not {0.0, 1.0}.issuperset(flags):
            raise ValueError(f"it holds {len(flags)} numbers")
    except ValueError as error:
        raise UserError(f"attributes {path} cannot be read ({brief(error)}): {fix}") from None
    return [flag == 1 for flag in flags]
