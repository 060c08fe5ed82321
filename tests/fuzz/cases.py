"""One mutated file with its command, from a format, a seed and a number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

from tests.fuzz.containers import mutate_jpg, mutate_npz, mutate_png
from tests.fuzz.mutations import mutate_bytes
from tests.fuzz.seeds import SEEDS, Seed, seeds
from tests.fuzz.stores import mutate_db, mutate_h5
from tests.fuzz.tables import mutate_parquet
from tests.fuzz.texts import mutate_csv, mutate_header, mutate_toml
from tests.fuzz.zygote import SECONDS, Ending, Zygote

MEGABYTES = 1024  # that a command may take, with the libraries
FORMATS = tuple(SEEDS)
_STRUCTURED = 0.55  # share of the files whose mutation knows the format
_MUTATORS: dict[str, Callable[[bytes, Sequence[bytes], Random], bytes]] = {
    "npz": mutate_npz,
    "csv": mutate_csv,
    "parquet": mutate_parquet,
    "h5": mutate_h5,
    "db": mutate_db,
    "pfm": mutate_header,
    "png": mutate_png,
    "pgm": mutate_header,
    "jpg": mutate_jpg,
    "toml": mutate_toml,
    "manifest": mutate_parquet,
}


def make_case(kind: str, seed: int, number: int) -> Seed:
    """The command and its files, one of them mutated; the same for the same arguments."""
    rng = Random(f"{kind} {seed} {number}")
    known = seeds(kind)
    chosen = rng.choice(known)
    target = rng.choice(chosen.targets)
    others = [other.files[name] for other in known for name in other.targets]
    mutate = _MUTATORS[kind] if rng.random() < _STRUCTURED else mutate_bytes
    return Seed(chosen.arguments, chosen.files | {target: mutate(chosen.files[target], others, rng)}, (target,))


def run_case(zygote: Zygote, case: Seed, folder: Path, *, seconds: float = SECONDS) -> tuple[Ending, str]:
    """Run a command in an empty folder; how it ended, and what is wrong with that, if anything."""
    for name, data in case.files.items():
        (folder / name).write_bytes(data)
    ending = zygote.run(case.arguments, folder, seconds=seconds)
    return ending, find_fault(ending, case, folder)


def find_fault(ending: Ending, case: Seed, folder: Path) -> str:
    """What a command has done that none may do; empty if nothing."""
    lines = [line for line in ending.errors if not line.startswith("tensor-stereo: warning")]
    if ending.hung:
        return f"no answer within {ending.seconds:.0f} s"
    if ending.code < 0:
        return f"ended by signal {-ending.code}"
    if any("Traceback (most recent call last)" in line for line in lines):
        return "a traceback"
    if ending.megabytes > MEGABYTES:
        return f"{ending.megabytes:.0f} MB of memory"
    if ending.code not in (0, 1, 2):
        return f"exit code {ending.code}"
    if len(lines) != (ending.code != 0):
        return f"{len(lines)} lines on standard error with exit code {ending.code}"
    if lines and not lines[0].startswith("tensor-stereo: "):
        return "an error that is not the program's"
    changed = [name for name, data in case.files.items() if (folder / name).read_bytes() != data]
    if changed:
        return f"changed its input {changed[0]}"
    known = {*case.files, ".stdout", ".stderr", ".usage"}
    left = sorted(path.name for path in folder.iterdir() if path.name not in known)
    allowed = [name for name in left if ending.code != 2 and name in case.arguments]
    return f"left {left[0]} behind with exit code {ending.code}" if left != allowed else ""
