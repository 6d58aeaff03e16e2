#!/usr/bin/env python3
"""Builds the Python wheel out of what cargo built, and tests it in a fresh virtual environment.

The wheel goes to target/wheels. What cannot be had (Python 3.10, the package index) is said in one line, and with
--test the tests are left out then; a test that fails, fails.
"""

import argparse
import glob
import os
import shutil
import subprocess
import sys
from typing import List, Optional, Sequence, Type

import stage
from common import SetupError, pip_environment, say
from stage import CHECKOUT, TARGET

WHEELS = os.path.join(TARGET, "wheels")
TOOLS = ("maturin==1.16.0", "wheel==0.45.1")
# Readers and writers of recordings that are not ours.
READERS = ("mcap==1.6.0", "mcap-ros2-support==0.6.0", "rosbags==0.11.9", "pyarrow==26.0.1")
# What runs the notebook.
NOTEBOOK = ("nbclient==0.11.0", "ipykernel==7.4.0")
# What the examples need beside the wheel: with CAUDATA_TEST_TRAINERS=1, since torch alone is gigabytes.
TRAINERS = ("torch==2.11.0", "stable-baselines3==2.9.2", "rsl-rl-lib==5.5.1")


class Left(Exception):
    """Why the wheel, or its test, is left out."""


def main(arguments: Optional[List[str]] = None) -> int:
    parser = argparse.ArgumentParser(prog="setup/wheel.py", description=__doc__)
    parser.add_argument("--test", action="store_true", help="install the wheel and run python/tests on it")
    options = parser.parse_args(arguments)
    try:
        wheel = build()
        say("wheel: %s, %.0f MB" % (os.path.relpath(wheel), os.path.getsize(wheel) / 1e6))
        return test(wheel) if options.test else 0
    except Left as reason:
        say("wheel: left out%s: %s" % (", and with it the tests in python/tests" if options.test else "", reason))
        return 0 if options.test else 1
    except SetupError as error:
        say("error: %s" % error)
        return error.exit_code


def build() -> str:
    """Packs what cargo has built with the workspace; maturin says what the package is called and asks for."""
    if sys.version_info < (3, 10):
        raise Left("the package needs Python 3.10 or newer, this is %s" % sys.version.split()[0])
    module = os.path.join(TARGET, "release", "lib_caudata.so")
    if not os.path.exists(module):
        raise SetupError("%s is missing: `make build` makes it" % os.path.relpath(module))
    tools = environment("wheel-tools", TOOLS)
    layout = os.path.join(TARGET, "wheel")
    shutil.rmtree(layout, ignore_errors=True)
    package = os.path.join(layout, "caudata")
    unwanted = shutil.ignore_patterns("__pycache__", "*.so")
    shutil.copytree(os.path.join(CHECKOUT, "python", "caudata"), package, ignore=unwanted)
    stage.copy_program(module, os.path.join(package, "_caudata.abi3.so"))
    carry(package)
    maturin = [os.path.join(tools, "bin", "maturin"), "pep517", "write-dist-info", "--metadata-directory", layout]
    run(SetupError, *maturin, "--manifest-path", os.path.join(CHECKOUT, "python", "Cargo.toml"))
    shutil.rmtree(WHEELS, ignore_errors=True)
    os.makedirs(WHEELS)
    run(SetupError, os.path.join(tools, "bin", "python"), "-m", "wheel", "pack", "--dest-dir", WHEELS, layout)
    return glob.glob(os.path.join(WHEELS, "*.whl"))[0]


def carry(package: str) -> None:
    """Puts programs, robots, policies, examples and the set-up into the package."""
    stage.stage(package)
    examples = os.path.join(CHECKOUT, "python", "examples")
    shutil.copytree(examples, os.path.join(package, "examples"), ignore=shutil.ignore_patterns("__pycache__"))
    folder = os.path.join(package, "setup")
    os.mkdir(folder)
    for path in glob.glob(os.path.join(CHECKOUT, "setup", "*.py")):
        if not os.path.basename(path).startswith(("test_", "wheel", "dist", "lines", "site", "stage")):
            shutil.copy(path, folder)
    os.rename(os.path.join(package, "_setup_main.py"), os.path.join(folder, "__main__.py"))


def test(wheel: str) -> int:
    more = TRAINERS if os.environ.get("CAUDATA_TEST_TRAINERS") == "1" else ()
    folder = environment("wheel-test", [wheel, *READERS, *NOTEBOOK, *more])
    # Neither the checkout nor what it provisioned is there for an installed package.
    clean = {name: value for name, value in os.environ.items() if name not in ("ORT_DYLIB_PATH", "PYTHONPATH")}
    tests = os.path.join(CHECKOUT, "python", "tests")
    command = [os.path.join(folder, "bin", "python"), "-m", "unittest", "discover", "-s", tests, "-b"]
    # Nor do robots/ and policies/ of the checkout lie in the current folder of somebody who installed it.
    return subprocess.run(command, cwd=folder, env=clean).returncode


def environment(name: str, packages: Sequence[str]) -> str:
    """A fresh virtual environment below target/ with these packages."""
    folder = os.path.join(TARGET, name)
    shutil.rmtree(folder, ignore_errors=True)
    # Without pip inside, because Debian keeps ensurepip in a package of its own; ours installs from outside.
    run(Left, sys.executable, "-m", "venv", "--without-pip", folder)
    python = os.path.join(folder, "bin", "python")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--disable-pip-version-check"]
    run(Left, *pip, "--only-binary=:all:", *packages)
    return folder


def run(failure: Type[Exception], *command: str) -> None:
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=pip_environment())
    if done.returncode != 0:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        errors = [line for line in lines if line.lower().startswith("error")] or lines[-1:] or ["no message"]
        raise failure("%s: %s" % (" ".join(command[:4]), errors[-1]))


if __name__ == "__main__":
    sys.exit(main())
