"""How well a policy walks."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional

from . import _programs
from ._data import policy_path, robot_path


@dataclass(frozen=True)
class Evaluation:
    """What ``caudata eval`` measured; ``docs/reference/json.md`` lists the keys."""

    suite: str
    policy_sha256: str
    scenarios: List[Dict[str, Any]]
    raw: Dict[str, Any]

    @property
    def walks(self) -> bool:
        """Whether every gate of every scenario that has gates is met."""
        gates = [scenario["gates"] for scenario in self.scenarios if scenario["gates"] is not None]
        return bool(gates) and all(gate["walks"] for gate in gates)

    @property
    def velocity_mps(self) -> float:
        """Mean forward velocity in the first scenario, m/s."""
        return float(self.scenarios[0]["vx_mps"]["mean"])


def evaluate(
    policy: "str | os.PathLike[str]",
    *,
    preset: Optional[str] = None,
    robot: "str | os.PathLike[str] | None" = None,
    suite: str = "flat",
    episodes: int = 256,
    seconds: float = 20.0,
    seed: int = 1,
    report: "str | os.PathLike[str] | None" = None,
) -> Evaluation:
    """Measures a policy in simulation, without exploration noise.

    :param policy: name of a policy of the package, or an ONNX file.
    :param preset: the task; without it the one that the policy was made for, where the program can tell.
    :param report: where to write a page with tables, curves and a replay, for a browser.
    """
    words = ["eval", str(policy_path(policy)), "--json", "--suite", suite, "--episodes", str(episodes)]
    words += ["--seconds", str(seconds), "--seed", str(seed)]
    if preset is not None:
        words += ["--preset", preset]
    if robot is not None:
        words += ["--robot", str(robot_path(robot))]
    if report is not None:
        words += ["--report", str(Path(report))]
    raw = json.loads(_programs.run(*words, quiet=True).splitlines()[-1])
    return Evaluation(raw["suite"], raw["policy_sha256"], raw["scenarios"], raw)
