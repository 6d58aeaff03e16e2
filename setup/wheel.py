#!/usr/bin/env python3
"""Builds the Python wheel out of what cargo built, and tests it in a fresh virtual environment.

The wheel goes to target/wheels, that for aarch64 (--arm) to target/arm/wheels. What cannot be had (Python 3.10, the
package index) is said in one line, and with --test the tests are left out then; a test that fails, fails. That for
aarch64 is tried under emulation: Debian's Python, the environments, a policy and each program.
"""

import argparse
import glob
import os
import shutil
import subprocess
import sys
from typing import List, Optional, Sequence, Type

import arm
import parts
import pins
import stage
from common import SetupError, pip_environment, say
from stage import CHECKOUT, TARGET

TOOLS = ("maturin==1.16.0", "wheel==0.45.1")
# Readers and writers of recordings that are not ours.
READERS = ("mcap==1.6.0", "mcap-ros2-support==0.6.0", "rosbags==0.11.9", "pyarrow==26.0.1", "tensorboard==2.20.0")
# What runs the notebook.
NOTEBOOK = ("nbclient==0.11.0", "ipykernel==7.4.0")
# What the examples need beside the wheel: with CAUDATA_TEST_TRAINERS=1, since torch alone is gigabytes.
TRAINERS = ("torch==2.11.0", "stable-baselines3==2.9.2", "rsl-rl-lib==5.5.1")


class Left(Exception):
    """Why the wheel, or its test, is left out."""


def main(arguments: Optional[List[str]] = None) -> int:
    parser = argparse.ArgumentParser(prog="setup/wheel.py", description=__doc__)
    parser.add_argument("--test", action="store_true", help="install the wheel and run python/tests on it")
    parser.add_argument("--arm", action="store_true", help="of what `make wheel-arm` built for aarch64")
    options = parser.parse_args(arguments)
    try:
        wheel = build(options.arm)
        say("wheel: %s, %.0f MB" % (os.path.relpath(wheel), os.path.getsize(wheel) / 1e6))
        if not options.test:
            return 0
        return test_arm(wheel) if options.arm else test(wheel)
    except Left as reason:
        say("wheel: left out%s: %s" % (", and with it the tests in python/tests" if options.test else "", reason))
        return 0 if options.test else 1
    except SetupError as error:
        say("error: %s" % error)
        return error.exit_code


def build(for_arm: bool) -> str:
    """Packs what cargo has built with the workspace; maturin says what the package is called and asks for."""
    if sys.version_info < (3, 10):
        raise Left("the package needs Python 3.10 or newer, this is %s" % sys.version.split()[0])
    root = os.path.join(CHECKOUT, "target", "arm") if for_arm else TARGET
    release = os.path.join(root, arm.TARGET, "release") if for_arm else os.path.join(root, "release")
    strip = "aarch64-linux-gnu-strip" if for_arm else "strip"
    module = os.path.join(release, "lib_caudata.so")
    if not os.path.exists(module):
        raise SetupError("%s is missing: `make build`, or `make wheel-arm`, makes it" % os.path.relpath(module))
    tools = environment("wheel-tools", TOOLS)
    layout = os.path.join(root, "wheel")
    shutil.rmtree(layout, ignore_errors=True)
    package = os.path.join(layout, "caudata")
    unwanted = shutil.ignore_patterns("__pycache__", "*.so")
    shutil.copytree(os.path.join(CHECKOUT, "python", "caudata"), package, ignore=unwanted)
    stage.copy_program(module, os.path.join(package, "_caudata.abi3.so"), strip)
    stage.stage(package, release, strip)
    carry(package)
    maturin = [os.path.join(tools, "bin", "maturin"), "pep517", "write-dist-info", "--metadata-directory", layout]
    run(SetupError, *maturin, "--manifest-path", os.path.join(CHECKOUT, "python", "Cargo.toml"))
    if for_arm:  # maturin says what it runs on
        (tags,) = glob.glob(os.path.join(layout, "*.dist-info", "WHEEL"))
        with open(tags) as file:
            text = file.read()
        with open(tags, "w") as file:
            file.write(text.replace("x86_64", "aarch64"))
    wheels = os.path.join(root, "wheels")
    shutil.rmtree(wheels, ignore_errors=True)
    os.makedirs(wheels)
    run(SetupError, os.path.join(tools, "bin", "python"), "-m", "wheel", "pack", "--dest-dir", wheels, layout)
    return glob.glob(os.path.join(wheels, "*.whl"))[0]


def carry(package: str) -> None:
    """Puts examples and the set-up into the package."""
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


# What is tried on aarch64, in Python.
TRIED = """
import subprocess, sys
import numpy as np
import caudata
from caudata._programs import environment, program
envs = caudata.make_vec("quadruped", num_envs=4, seed=1)
observations, _ = envs.reset()
policy = caudata.Policy("flat")
walks = caudata.make_vec("polymander", "flat", num_envs=2, seed=1)
seen, _ = walks.reset()
for _ in range(50):
    envs.step(np.zeros(envs.action_space.shape, np.float32))
    seen = walks.step(policy(seen))[0]
assert np.isfinite(seen).all()
speed = caudata.evaluate("flat", episodes=1, seconds=5).velocity_mps
assert speed > 0.2, speed
print("walks at %.3f m/s" % speed)
for name in sys.argv[1:]:
    print(subprocess.run([program(name), "--version"], env=environment(), check=True, stdout=subprocess.PIPE, text=True).stdout, end="")
"""


def test_arm(wheel: str) -> int:
    root = arm.debian("python-aarch64", [name + ":arm64" for name in arm.DEBIAN_PYTHON])
    if not os.path.lexists(os.path.join(root, "lib")):  # where programs look for their loader
        os.symlink(os.path.join("usr", "lib"), os.path.join(root, "lib"))
    python = glob.glob(os.path.join(root, "usr", "bin", "python3.*[0-9]"))[0]
    site = os.path.join(os.path.dirname(os.path.dirname(wheel)), "wheel-test")
    shutil.rmtree(site, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--target", site]
    pip += ["--only-binary=:all:", "--implementation", "cp", "--python-version", python.rsplit("python", 1)[1]]
    pip += ["--abi", "cp" + python.rsplit("python", 1)[1].replace(".", ""), "--abi", "abi3", "--abi", "none"]
    for platform in ("linux", "manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014"):
        pip += ["--platform", platform + "_aarch64"]
    run(Left, *pip, wheel)
    libtorch = parts.provision(pins.LIBTORCH["aarch64"])
    values = {"PYTHONPATH": site, "PYTHONHOME": os.path.join(root, "usr"), "LIBTORCH": libtorch}
    values.update(QEMU_LD_PREFIX=root, QEMU_CPU="max", PATH=os.environ["PATH"], HOME=site)
    values["LD_LIBRARY_PATH"] = os.path.join(root, "usr", "lib", "aarch64-linux-gnu")
    return subprocess.run([python, "-c", TRIED, *stage.PROGRAMS], cwd=site, env=values).returncode


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
