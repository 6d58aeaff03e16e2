"""``python -m caudata.hub POLICY FOLDER``: a policy as a folder that a hub of models takes as it is.

The folder has the policy, its manifest, settings and evaluation as far as they lie beside it, the robot (two files:
an imported one has its meshes as boxes in them), the map of the ground if there is one, a moving picture, and a card
(``README.md``). Whoever downloads such a folder uses the policy in it as any other: the card says how. Nothing here
speaks to a hub; its own tools do.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, Dict, List

from . import _programs
from ._data import policy_path, robot_path

_CARD = """---
library_name: caudata
pipeline_tag: reinforcement-learning
tags: [robotics, locomotion, {robot}]
---

# {name}

![The robot walks](walk.gif)

A policy for the robot `{robot}`: {steps:.1f} million environment steps, SHA-256 `{sha256}`.

{table}
`manifest.json` says which joints, gains and observations it is made for.

```sh
caudata play policy.onnx --robot robot/{robot}.robot.toml
caudata eval policy.onnx --robot robot/{robot}.robot.toml
```
"""


def export(policy: Path, folder: Path, robot: "str | None" = None) -> Path:
    """Writes the folder, whole or not at all.

    :param robot: the robot's name or file, where no ``config.toml`` beside the policy says it
    :raises FileExistsError: the folder is there already
    :raises ValueError: nobody says which robot
    :raises ProgramError: the policy cannot be read, or does not fit the robot
    """
    if folder.exists():
        raise FileExistsError("%s is there already" % folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        made = Path(scratch, folder.name)
        made.mkdir()
        _fill(policy, made, robot)
        made.rename(folder)
    return folder


def _fill(policy: Path, folder: Path, robot: "str | None") -> None:
    manifest = json.loads(_programs.run("policy", "show", policy, "--json").splitlines()[-1])
    manifest.pop("path", None)
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    shutil.copy(policy, folder / "policy.onnx")
    beside = policy.with_name("config.toml")
    settings = beside.read_text(encoding="utf-8") if beside.exists() else ""
    robot = robot or _value(settings, "robot")
    if not robot:
        raise ValueError("%s: no config.toml beside it says which robot; give --robot" % policy)
    model = Path(robot_path(robot))
    name = model.name.removesuffix(".robot.toml")
    (folder / "robot").mkdir()
    for path in (model, model.with_name(_value(model.read_text(encoding="utf-8"), "mjcf"))):
        shutil.copy(path, folder / "robot")
    if settings:
        ground = Path(_value(settings, "map"))
        moved = {"robot": "robot/" + model.name, "map": "ground" + ground.suffix}
        if ground.name:
            shutil.copy(ground, folder / moved["map"])
        path = re.compile("^(robot|map) *= *[\"'].+[\"']", re.M)
        settings = path.sub(lambda key: '%s = "%s"' % (key[1], moved[key[1]]), settings)
        (folder / "config.toml").write_text(settings, encoding="utf-8")
    evaluation: Dict[str, Any] = {}
    if manifest["evaluation"] is not None:
        evaluation = manifest["evaluation"]
        (folder / "evaluation.json").write_text(json.dumps(evaluation, indent=1) + "\n", encoding="utf-8")
    film = ["sim", "show", "--robot", model, "--policy", policy, "--out", folder / "walk.gif"]
    _programs.run(*film, "--seconds", "2.4", "--width", "320", "--fps", "10", "--settle-s", "3", quiet=True)
    card = _CARD.format(
        name=folder.name,
        robot=name,
        steps=manifest["metadata"]["env_steps"] / 1e6,
        sha256=manifest["sha256"],
        table=table(evaluation.get("scenarios", [])),
    )
    (folder / "README.md").write_text(card, encoding="utf-8")


def _value(text: str, key: str) -> str:
    """The string of a key of a TOML text, or none."""
    found = re.search("^%s *= *[\"'](.*?)[\"']" % key, text, re.M)
    return found.group(1) if found else ""


def table(scenarios: List[Dict[str, Any]]) -> str:
    """What was measured, in simulation."""
    if not scenarios:
        return ""
    rows = ["| in simulation | forward, m/s | falls | power, W | walks |", "|---|---|---|---|---|"]
    for s in scenarios:
        verdict = {True: "yes", False: "no: " + "; ".join(s["missed"]), None: "–"}[s["walks"]]
        figures = (s["name"], s["achieved"][0], 100 * s["fall_share"], s["power_w"], verdict)
        rows.append("| %s | %.3f | %.1f %% | %.1f | %s |" % figures)
    return "\n".join(rows) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m caudata.hub", description=__doc__)
    parser.add_argument("policy", help="a policy of the package, or an ONNX file")
    parser.add_argument("folder", type=Path, help="a folder that is not there yet")
    parser.add_argument("--robot", help="the robot's name or file, where no config.toml beside the policy says it")
    options = parser.parse_args()
    try:
        print(export(Path(policy_path(options.policy)), options.folder, options.robot))
    except _programs.ProgramError as error:
        print(error, file=sys.stderr)
        return error.code
    except ValueError as error:
        print("error: %s" % error, file=sys.stderr)
        return 64
    except OSError as error:
        print("error: %s" % error, file=sys.stderr)
        return 73
    return 0


if __name__ == "__main__":
    sys.exit(main())
