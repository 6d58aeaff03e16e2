"""Writes what was provisioned where cargo and shells find it: .cargo/config.toml and .cargo/env.sh."""

import os
import shlex
from typing import Dict

from common import say

MARK = "# Written by setup/provision.py, overwritten by the next run. Remove this line to keep your own changes."


def exports(values: Dict[str, str]) -> str:
    return "".join("export %s=%s\n" % (name, shlex.quote(value)) for name, value in values.items())


def cargo_config(values: Dict[str, str]) -> str:
    # Without `force`, so a variable that is set in the shell wins over this file.
    lines = [MARK, "[env]"] + ["%s = %s" % (name, _toml_string(value)) for name, value in values.items()]
    return "\n".join(lines) + "\n"


def write(checkout: str, values: Dict[str, str]) -> None:
    folder = os.path.join(checkout, ".cargo")
    os.makedirs(folder, exist_ok=True)
    _write_if_changed(os.path.join(folder, "env.sh"), "# Written by setup/provision.py.\n" + exports(values))
    config = os.path.join(folder, "config.toml")
    if os.path.exists(config) and not _is_ours(config):
        if cargo_config(values).split("\n", 1)[1] not in _read(config):
            say(
                "%s is your own and stays as it is: for a plain `cargo build`, source %s first"
                % (config, os.path.join(folder, "env.sh"))
            )
        return
    _write_if_changed(config, cargo_config(values))


def _is_ours(path: str) -> bool:
    return _read(path).startswith(MARK)


def _read(path: str) -> str:
    with open(path, encoding="utf-8") as file:
        return file.read()


def _write_if_changed(path: str, text: str) -> None:
    if os.path.exists(path) and _read(path) == text:
        return
    scratch = "%s.tmp-%d" % (path, os.getpid())
    with open(scratch, "w", encoding="utf-8") as file:
        file.write(text)
    os.replace(scratch, path)


def _toml_string(text: str) -> str:
    return '"%s"' % text.replace("\\", "\\\\").replace('"', '\\"')
