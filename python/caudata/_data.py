"""The robots, policies and presets that come with the package."""

from __future__ import annotations

import os
from pathlib import Path
from typing import List

from ._caudata import preset_names

HOME = Path(__file__).parent
"""The package's folder: programs, robots and policies lie below it."""
_ROBOT = ".robot.toml"
_POLICY = ".onnx"


def robots() -> List[str]:
    """Names of the robots that come with the package."""
    return sorted(path.name[: -len(_ROBOT)] for path in (HOME / "robots").glob("*" + _ROBOT))


def policies() -> List[str]:
    """Names of the policies that come with the package."""
    return sorted(path.stem for path in (HOME / "policies").glob("*" + _POLICY))


def presets() -> List[str]:
    """Names of the presets: tasks with the way to train them."""
    return list(preset_names())


def robot_path(robot: "str | os.PathLike[str]") -> Path:
    """The file of a robot that is given by name or by path."""
    return _find(robot, "robots", _ROBOT, robots())


def policy_path(policy: "str | os.PathLike[str]") -> Path:
    """The file of a policy that is given by name or by path."""
    return _find(policy, "policies", _POLICY, policies())


def _find(what: "str | os.PathLike[str]", folder: str, end: str, known: List[str]) -> Path:
    path = Path(what)
    if path.name.endswith(end):
        if path.is_file():
            return path.resolve()
        raise FileNotFoundError("%s: there is no such file" % path)
    if path.suffix in (".xml", ".urdf") and path.is_file():
        raise ValueError("%s is no robot file: `caudata robot import %s` makes one of it" % (path, path))
    packaged = HOME / folder / (str(what) + end)
    if packaged.is_file():
        return packaged
    raise FileNotFoundError(
        "there is no '%s' among the %s of the package (%s); give one of these or a file *%s"
        % (what, folder, ", ".join(known), end)
    )
