#!/usr/bin/env python3
"""Lays out the programs with all that they load, so that the folder runs anywhere on Linux with the same or a newer
C library; packs it as target/caudata-VERSION-ARCHITECTURE.tar.gz, installs it, or tests it.

    bin/            programs, and ONNX Runtime beside them
    lib/            libtorch, for caudata-learner
    robots/ policies/
    licenses/       ours, those of the libraries, and a list of every crate with its licence
    share/          completions for bash, zsh and fish; man pages
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
from typing import List, Optional

import pins
import provision
import stage
from common import SetupError, machine, say
from stage import CHECKOUT, TARGET

SHELLS = ("bash", "zsh", "fish")


def main(arguments: Optional[List[str]] = None) -> int:
    parser = argparse.ArgumentParser(prog="setup/dist.py", description=__doc__.split("\n\n")[0])
    parser.add_argument("--install", metavar="PREFIX", help="install into PREFIX/lib/caudata, PREFIX/bin, PREFIX/share")
    parser.add_argument("--test", action="store_true", help="run the programs from another place with nothing set")
    options = parser.parse_args(arguments)
    try:
        if options.install:
            install(os.path.abspath(options.install))
        elif options.test:
            with tempfile.TemporaryDirectory() as scratch:
                test(lay_out(os.path.join(scratch, "somewhere else")), scratch)
        else:
            say("archive: %s" % os.path.relpath(pack()))
    except SetupError as error:
        say("error: %s" % error)
        return error.exit_code
    return 0


def pack() -> str:
    name = "caudata-%s-%s" % (version(), machine())
    folder = lay_out(os.path.join(TARGET, "dist", name))
    archive = os.path.join(TARGET, name + ".tar.gz")
    with tarfile.open(archive + ".tmp", "w:gz", compresslevel=6) as tar:
        tar.add(folder, arcname=name)
    os.replace(archive + ".tmp", archive)
    return archive


def lay_out(folder: str) -> str:
    shutil.rmtree(folder, ignore_errors=True)
    stage.stage(folder)
    torch, runtime = provision.libtorch(verify=False), provision.onnxruntime(verify=False)
    shutil.copy(os.path.realpath(runtime), os.path.join(folder, "bin", "libonnxruntime.so"))
    os.mkdir(os.path.join(folder, "lib"))
    for path in pins.LIBTORCH[machine()].libraries:
        shutil.copy(os.path.join(torch, path), os.path.join(folder, "lib"))
    licences(os.path.join(folder, "licenses"), torch, os.path.dirname(os.path.dirname(runtime)))
    program = os.path.join(folder, "bin", "caudata")
    for shell in SHELLS:
        out = os.path.join(folder, "share", "completions", "caudata." + shell)
        os.makedirs(os.path.dirname(out), exist_ok=True)
        with open(out, "w") as file:
            subprocess.run([program, "completions", shell], stdout=file, check=True)
    subprocess.run([program, "man", "--out", os.path.join(folder, "share", "man", "man1")], check=True)
    return folder


def licences(folder: str, torch: str, runtime: str) -> None:
    os.makedirs(folder)
    for name in ("LICENSE-MIT", "LICENSE-APACHE"):
        shutil.copy(os.path.join(CHECKOUT, name), folder)
    if os.path.isdir(os.path.join(torch, "licenses")):
        shutil.copytree(os.path.join(torch, "licenses"), folder, dirs_exist_ok=True)
    for name in ("LICENSE", "ThirdPartyNotices.txt"):
        if os.path.exists(os.path.join(runtime, name)):
            shutil.copy(os.path.join(runtime, name), os.path.join(folder, "onnxruntime-" + name))
    command = ["cargo", "metadata", "--format-version", "1", "--locked"]
    command += ["--filter-platform", platform.machine() + "-unknown-linux-gnu"]
    done = subprocess.run(command, cwd=CHECKOUT, stdout=subprocess.PIPE, check=True)
    packages = json.loads(done.stdout)["packages"]
    with open(os.path.join(folder, "crates.txt"), "w") as file:
        file.write("Crates that the programs are built from, with licence and source.\n\n")
        for package in sorted(packages, key=lambda p: (p["name"], p["version"])):
            if package["source"] is not None:
                licence = package["license"] or "see its source"
                where = package["repository"] or ""
                file.write("%s %s: %s  %s\n" % (package["name"], package["version"], licence, where))


def version() -> str:
    command = ["cargo", "metadata", "--format-version", "1", "--no-deps", "--locked"]
    done = subprocess.run(command, cwd=CHECKOUT, stdout=subprocess.PIPE, check=True)
    return next(p["version"] for p in json.loads(done.stdout)["packages"] if p["name"] == "caudata")


def install(prefix: str) -> None:
    """The folder below PREFIX/lib, links to its programs in PREFIX/bin, completions and man pages where they belong."""
    folder = lay_out(os.path.join(prefix, "lib", "caudata"))
    os.makedirs(os.path.join(prefix, "bin"), exist_ok=True)
    for name in stage.PROGRAMS:
        link = os.path.join(prefix, "bin", name)
        if os.path.lexists(link):
            os.remove(link)
        os.symlink(os.path.join("..", "lib", "caudata", "bin", name), link)
    places = (
        ("completions/caudata.bash", "bash-completion/completions/caudata"),
        ("completions/caudata.zsh", "zsh/site-functions/_caudata"),
        ("completions/caudata.fish", "fish/vendor_completions.d/caudata.fish"),
        ("man", "man"),
    )
    for source, target in places:
        source, target = os.path.join(folder, "share", source), os.path.join(prefix, "share", target)
        os.makedirs(os.path.dirname(target), exist_ok=True)
        if os.path.isdir(source):
            shutil.copytree(source, target, dirs_exist_ok=True)
        else:
            shutil.copy(source, target)
    say("installed: %s" % os.path.join(prefix, "bin", "caudata"))


def test(folder: str, scratch: str) -> None:
    """With an empty environment and in an empty folder, so that only what is laid out can be found."""
    work = os.path.join(scratch, "work")
    os.mkdir(work)
    caudata = os.path.join(folder, "bin", "caudata")
    robot_page = ["sim", "show", "--out", "robot.png", "--width", "160"]
    walk = ["eval", "policies/flat.onnx", "--suite", "flat", "--episodes", "1", "--seconds", "4"]
    train = ["train", "--iterations", "2", "--set", "evaluation.episodes=1", "--set", "actors.lanes=8"]
    for words in (["--version"], robot_page, walk, train):
        done = subprocess.run([caudata, *words], cwd=work, env={}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        if done.returncode != 0:
            raise SetupError("caudata %s: %s" % (" ".join(words), done.stdout.decode("utf-8", "replace")))
    say("the folder runs from another place with nothing set: %d commands" % 4)


if __name__ == "__main__":
    sys.exit(main())
