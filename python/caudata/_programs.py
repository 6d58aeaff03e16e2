"""The programs of the package, with the libraries that they load."""

from __future__ import annotations

import importlib.util
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, NoReturn, Optional

from ._data import HOME

_LIBTORCH_VERSION = "2.11"
_NO_LIBTORCH = (
    "training needs libtorch %s, which is not in this package: run `python -m caudata.setup` (downloads 0.5 GB, keeps"
    " 0.5 GB in ~/.cache/caudata), or `pip install torch==%s.0`, or set LIBTORCH to your own"
    % (_LIBTORCH_VERSION, _LIBTORCH_VERSION)
)


class ProgramError(RuntimeError):
    """A program refused or failed: its error line and its exit code."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code
        """See ``docs/reference/exit-codes.md``."""


def program(name: str) -> Path:
    """The path of a program, for instance ``caudata``; ``CAUDATA_BIN`` names another folder to take it from."""
    path = Path(os.environ.get("CAUDATA_BIN") or HOME / "bin") / name
    if not path.is_file():
        raise FileNotFoundError("%s: this build of the package has no programs; set CAUDATA_BIN to their folder" % path)
    return path


def environment() -> Dict[str, str]:
    """The environment that programs run in: it says where ONNX Runtime and, if there is one, libtorch are.

    Recordings that Python's libraries read are read by this Python.
    """
    out = dict(os.environ)
    out.setdefault("CAUDATA_PYTHON", sys.executable)
    runtime = _onnxruntime()
    if runtime is not None:
        out.setdefault("ORT_DYLIB_PATH", str(runtime))
    torch = libtorch()
    if torch is not None:
        old = out.get("LD_LIBRARY_PATH")
        out["LD_LIBRARY_PATH"] = str(torch) + (os.pathsep + old if old else "")
    return out


def _onnxruntime() -> Optional[Path]:
    """The library inside of PyPI's ``onnxruntime``."""
    spec = importlib.util.find_spec("onnxruntime")
    if spec is None or spec.origin is None:
        return None
    found = sorted((Path(spec.origin).parent / "capi").glob("libonnxruntime.so.*.*"))
    return found[0] if found else None


def libtorch() -> Optional[Path]:
    """The folder of libtorch's libraries: ``LIBTORCH``, what `python -m caudata.setup` provisioned, PyPI's ``torch``."""
    if os.environ.get("LIBTORCH"):
        return Path(os.environ["LIBTORCH"]) / "lib"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "caudata"
    # there may be one for another processor beside it
    for folder in sorted(cache.glob("libtorch-%s.*-%s" % (_LIBTORCH_VERSION, platform.machine()))):
        if (folder / "stamp.json").is_file():
            return folder / "lib"
    spec = importlib.util.find_spec("torch")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        version = (folder / "version.py").read_text()
        if "'%s." % _LIBTORCH_VERSION in version:
            return folder / "lib"
    return None


def run(*arguments: "str | os.PathLike[str]", quiet: bool = False) -> str:
    """Runs ``caudata`` with these arguments and returns what it printed; raises :class:`ProgramError` if it fails.

    :param quiet: keeps its progress and warnings (standard error) to itself.
    """
    done = finish(*arguments, quiet=quiet)
    if done.returncode != 0:
        raise failure(done)
    return done.stdout


def finish(*arguments: "str | os.PathLike[str]", quiet: bool = False) -> "subprocess.CompletedProcess[str]":
    """As :func:`run`, whatever the exit code."""
    words = [str(program("caudata")), *map(os.fspath, arguments)]
    done = subprocess.run(words, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if not quiet:
        sys.stderr.write(done.stderr)
    return done


def failure(done: "subprocess.CompletedProcess[str]") -> ProgramError:
    """What a program that failed has said."""
    lines = [line for line in done.stderr.splitlines() if line.startswith(("error: ", "hint: "))]
    return ProgramError(done.returncode, "; ".join(lines) or "exit code %d" % done.returncode)


def needs_libtorch(name: str, words: List[str]) -> bool:
    """Whether a command starts the learner."""
    if any(word in ("-h", "--help", "-V", "--version") for word in words):
        return False
    command, *more = [word for word in words if not word.startswith("-")] or [""]
    trains = command in ("train", "up", "adapt", "sweep", "explain")
    trains |= command == "bench" and more[:1] in (["explain"], ["skill"], ["train"])
    return name == "caudata-learner" or (name == "caudata" and trains)


def _become(name: str) -> NoReturn:
    words: List[Any] = sys.argv[1:]
    if needs_libtorch(name, words) and libtorch() is None:
        sys.stderr.write("error: %s\n" % _NO_LIBTORCH)
        sys.exit(66)
    try:
        path = program(name)
    except FileNotFoundError as error:
        sys.stderr.write("error: %s\n" % error)
        sys.exit(66)
    os.execve(path, [name, *words], environment())


def caudata() -> NoReturn:
    _become("caudata")


def caudata_actor() -> NoReturn:
    _become("caudata-actor")


def caudata_learner() -> NoReturn:
    _become("caudata-learner")


def caudata_policy_server() -> NoReturn:
    _become("caudata-policy-server")


def caudata_robot() -> NoReturn:
    _become("caudata-robot")


def caudata_ros2() -> NoReturn:
    _become("caudata-ros2")
