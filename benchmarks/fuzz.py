"""Damage files of every format that is read, and check that each reader takes them or refuses them in one line.

    python benchmarks/fuzz.py --cases 100000
    python benchmarks/fuzz.py --readers mat onnx --cases 2000
    python benchmarks/fuzz.py --readers mat --first 1234 --cases 1     # one case again, with its traceback
    python benchmarks/fuzz.py --readers boxes --guided --cases 100000  # by coverage (pip install atheris)

Each reader runs in a process of its own, so that one that crashes is seen and named. A case depends on its number
alone. The exit code is 1 where a reader failed; the file that it failed on is kept.
"""

from __future__ import annotations

import argparse
import faulthandler
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from fuzz_seeds import SEEDS, Seed

from psiamfcpp.errors import UserError

_TOKENS = (
    b"", b"\0", b"\xff", b"\xff\xfe", b"\xef\xbb\xbf", b"nan", b"inf", b"-1", b"0", b"1e400", b"9" * 400, b"true",
    b"null", b"{}", b"[]", b"[" * 200, b'{"a":' * 200, b'"', b",", b"\n", b"\r", b"\xed\xa0\x80", b"../", b"%s" * 50,
    b"2147483647", b"4294967296", b"-9223372036854775808", b"<!ENTITY", b"\x1b[2J",
)  # fmt: skip
_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_SECONDS = 60


def damage(content: bytes, rng: random.Random) -> bytes:
    """Return the content with one to four changes."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        _CHANGES[rng.randrange(len(_CHANGES))](data, rng)
    return bytes(data)


def _at(data: bytearray, rng: random.Random) -> int:
    # headers are short and bodies long: half of the changes go to the beginning
    return rng.randrange(max(1, min(len(data), 512 if rng.random() < 0.5 else len(data))))


def _flip(data: bytearray, rng: random.Random) -> None:
    if data:
        data[_at(data, rng)] ^= 1 << rng.randrange(8)


def _byte(data: bytearray, rng: random.Random) -> None:
    if data:
        data[_at(data, rng)] = rng.randrange(256)


def _number(data: bytearray, rng: random.Random) -> None:
    at, size = _at(data, rng), rng.choice((1, 2, 4, 8))
    data[at : at + size] = rng.choice(_NUMBERS).to_bytes(8, "little")[:size]


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[_at(data, rng) :]


def _remove(data: bytearray, rng: random.Random) -> None:
    at = _at(data, rng)
    del data[at : at + rng.choice((1, 2, 8, 64, 1024))]


def _repeat(data: bytearray, rng: random.Random) -> None:
    at, size = _at(data, rng), rng.choice((1, 4, 16, 256))
    data[at:at] = data[at : at + size] * rng.choice((1, 2, 50))


def _insert(data: bytearray, rng: random.Random) -> None:
    at = _at(data, rng)
    data[at:at] = rng.choice(_TOKENS)


def _replace(data: bytearray, rng: random.Random) -> None:
    """Put something else in the place of a word, or of a number, of a text."""
    at = _at(data, rng)
    end = at
    while end < min(len(data), at + 40) and (data[end] in b".-_" or chr(data[end]).isalnum()):
        end += 1
    data[at:end] = rng.choice(_TOKENS)


_CHANGES: tuple[Callable[[bytearray, random.Random], None], ...] = (
    _flip, _byte, _number, _cut, _remove, _repeat, _insert, _replace,
)  # fmt: skip


def attempt(seed: Seed, place: Path, content: bytes) -> str | None:
    """Read a file; return None where the reader read or refused it as it should, else what went wrong."""
    place.write_bytes(content)
    try:
        seed.read(place)
    except UserError as error:
        return None if len(" ".join(str(error).split())) < 5000 else f"a message of {len(str(error))} characters"
    except Exception:
        return traceback.format_exc()
    return None


def case(name: str, seed: Seed, number: int) -> bytes:
    """Return the content of a case."""
    rng = random.Random(f"{name} {number}")
    return damage(rng.choice(seed.contents), rng)


def _work(name: str, make: Callable[[Path], Seed], numbers: range, counts: Any, faults: Any) -> None:
    """Run cases; ``counts`` holds the number of the current case, how many are done, and when it began."""
    faulthandler.disable()
    signal.signal(signal.SIGALRM, _too_slow)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    with tempfile.TemporaryDirectory() as folder:
        seed = make(Path(folder))
        counts[2] = counts[2] or time.monotonic_ns()
        for number in numbers:
            counts[0] = number
            signal.alarm(_SECONDS)
            fault = attempt(seed, seed.place, case(name, seed, number))
            signal.alarm(0)
            if fault is not None:
                faults.put((number, fault))
            counts[1] += 1
    faults.close()


def _too_slow(*_: object) -> None:
    raise TimeoutError(f"more than {_SECONDS} s")


def run(
    name: str, make: Callable[[Path], Seed], first: int, cases: int, seconds: float = float("inf")
) -> tuple[int, list[tuple[int, str]]]:
    """Run the cases of a reader in processes of its own.

    Args:
        name: of the reader, from which its cases are made.
        make: see `SEEDS`.
        first: number of the first case.
        cases: how many there are.
        seconds: after which no more are begun; the first imports do not count.

    Returns:
        How many were done, and number and description of each that failed.
    """
    context = multiprocessing.get_context("spawn")
    found: list[tuple[int, str]] = []
    counts, last = context.Array("q", [first, 0, 0]), first + cases
    while first < last:
        faults = context.Queue()
        worker = context.Process(target=_work, args=(name, make, range(first, last), counts, faults), daemon=True)
        worker.start()
        while worker.is_alive() and not (counts[2] and time.monotonic_ns() - counts[2] > seconds * 1e9):
            worker.join(0.5)
            _drain(faults, found)
        ended = not worker.is_alive()
        worker.kill()
        worker.join()
        _drain(faults, found)
        if not ended or worker.exitcode == 0:
            break
        found.append((counts[0], f"the process ended with {worker.exitcode}"))
        counts[1] += 1
        first = counts[0] + 1
    return counts[1], found


def _drain(faults: Any, found: list[tuple[int, str]]) -> None:
    while not faults.empty():
        found.append(faults.get())


def guided(name: str, cases: int) -> None:
    """Fuzz one reader by the coverage of its code, until it fails or so many cases are done; does not return."""
    import atheris

    folder = Path(tempfile.mkdtemp())
    with atheris.instrument_imports(include=["psiamfcpp"]):
        seed = SEEDS[name](folder)
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, content in enumerate(seed.contents):
        (corpus / str(number)).write_bytes(content)

    def one(data: bytes) -> None:
        fault = attempt(seed, seed.place, data)
        if fault is not None:
            raise RuntimeError(fault)

    atheris.Setup([sys.argv[0], f"-runs={cases}", "-max_len=65536", str(corpus)], one)
    atheris.Fuzz()


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readers", nargs="+", default=list(SEEDS), choices=list(SEEDS), metavar="READER")
    parser.add_argument("--cases", type=int, default=1000, help="of each reader")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="of each reader")
    parser.add_argument("--guided", action="store_true", help="one reader, by coverage, with atheris")
    options = parser.parse_args()
    if options.guided:
        guided(options.readers[0], options.cases)
    print(f"{'reader':12} {'cases':>8} {'failed':>7} {'ms a case':>10}")
    failed = 0
    for name in options.readers:
        start = time.monotonic()
        done, faults = run(name, SEEDS[name], options.first, options.cases, options.seconds)
        milliseconds = 1000 * (time.monotonic() - start) / max(done, 1)
        print(f"{name:12} {done:8} {len(faults):7} {milliseconds:10.1f}", flush=True)
        kinds = Counter(text.strip().splitlines()[-1][:160] for _, text in faults)
        for kind, count in kinds.most_common(10):
            number, text = next(fault for fault in faults if fault[1].strip().splitlines()[-1][:160] == kind)
            print(f"  {count} times, first case {number}: {kind}")
            if options.cases == 1:
                print(text)
        failed += len(faults)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
