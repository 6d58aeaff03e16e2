"""Logs of robots and simulations."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any, Dict, Iterator, Tuple

import numpy as np
from numpy.typing import NDArray

from . import _caudata


@dataclass(frozen=True)
class Log:
    """A run that was measured or simulated. Columns have one value per row, NaN where nothing was sampled."""

    meta: Dict[str, Any]
    """``log.toml``: robot, how its base was held, gains, and every other setting that was known."""
    time_s: NDArray[np.float64]
    columns: Dict[str, NDArray[np.float64]]
    """By the name of the signal, for instance ``pos.FL_hip`` (rad) or ``imu.gyro.x`` (rad/s)."""
    notes: Tuple[str, ...]
    """What the reader dropped or passed over."""

    def __getitem__(self, signal: str) -> NDArray[np.float64]:
        return self.columns[signal]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.time_s)

    def joints(self, kind: str = "pos") -> Dict[str, NDArray[np.float64]]:
        """The columns of one kind (``pos``, ``vel``, ``cmd``, ``cur``, ``tau``, ``temp``, ``pwm``) by joint."""
        begin = kind + "."
        return {name[len(begin) :]: values for name, values in self.columns.items() if name.startswith(begin)}


def read_log(folder: "str | os.PathLike[str]") -> Log:
    """Reads and checks a log folder: ``log.toml`` with ``log.csv`` or an MCAP file."""
    meta, time_s, columns, notes = _caudata.read_log(os.fspath(folder))
    return Log(json.loads(meta), time_s, columns, tuple(notes))
