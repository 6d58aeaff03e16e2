"""What a simulation gets wrong, from logs."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

from . import _programs
from ._data import robot_path

# A diagnosis that says "ambiguous" or "insufficient data" is an answer, too (docs/reference/exit-codes.md).
_ANSWERS = (0, 80, 81, 82, 83, 84)


@dataclass(frozen=True)
class Cause:
    """Something that the robot does and its simulation does not."""

    effect: str
    """Its name in the catalogue (``docs/reference/effects.md``)."""
    where: List[str]
    """Joints or links; empty: the whole robot."""
    parameters: Dict[str, Any]
    confidence: float
    """Calibrated probability that the name is right."""
    alternatives: List[str]
    """What explains it as well, alone or two together."""


@dataclass(frozen=True)
class Report:
    """What a diagnosis found."""

    verdict: str
    """``no_gap``, ``explained``, ``ambiguous``, ``partly_explained``, ``unexplained``, ``insufficient_data`` or
    ``data_fault``."""
    summary: str
    causes: List[Cause]
    gain: Dict[str, Any]
    """By signal: the error on held-out runs before and after."""
    raw: Dict[str, Any]
    """Everything; ``docs/reference/json.md`` lists the keys."""
    folder: Optional[Path]
    """Where ``report.html``, ``report.json`` and ``extended.robot.toml`` (where a model is carried) are, if they were kept."""


def diagnose(
    logs: "str | os.PathLike[str] | Sequence[str | os.PathLike[str]]",
    robot: "str | os.PathLike[str]",
    *,
    out: "str | os.PathLike[str] | None" = None,
    only: Sequence[str] = (),
    without: Sequence[str] = (),
    threads: Optional[int] = None,
    seed: int = 1,
) -> Report:
    """Says where simulation and measurement part, and why.

    :param logs: log folders, or a folder of log folders.
    :param robot: name of a robot of the package, or a ``*.robot.toml`` file.
    :param out: folder to keep the page and the extended robot file in.
    :param only: effects to try and no others; ``without``: effects not to try.
    """
    folders = [logs] if isinstance(logs, (str, os.PathLike)) else list(logs)
    words = ["gap", "diagnose", "--json", "--robot", str(robot_path(robot)), "--seed", str(seed)]
    for flag, values in (("--log", folders), ("--only", only), ("--without", without)):
        for value in values:
            words += [flag, os.fspath(value)]
    if threads is not None:
        words += ["--threads", str(threads)]
    with tempfile.TemporaryDirectory() as scratch:
        done = _programs.finish(*words, "--out", Path(out) if out is not None else Path(scratch) / "report", quiet=True)
    last = done.stdout.splitlines()[-1:]
    raw = json.loads(last[0]) if last else {}
    if done.returncode not in _ANSWERS or "verdict" not in raw:
        raise _programs.failure(done)
    keys = ("effect", "where", "parameters", "confidence", "alternatives")
    causes = [Cause(*(cause[key] for key in keys)) for cause in raw["causes"]]
    folder = None if out is None else Path(out)
    return Report(raw["verdict"], raw["summary"], causes, raw["gain"], raw, folder)
