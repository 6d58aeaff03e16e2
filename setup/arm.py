#!/usr/bin/env python3
"""Provisions what builds for the robot's processor (aarch64) and runs it here: a cross compiler, Rust's standard
library for it, QEMU's user-mode emulation, ONNX Runtime. Debian and its kin on x86-64; as root it installs what
is missing. Writes .cargo/arm.sh, which `make test-arm` reads.

Where the Rust that is here has no library for that processor (`rustup target add aarch64-unknown-linux-gnu`),
Debian's own Rust for both is unpacked into the cache, beside the libraries that it was built for: nothing of it
touches this system.
"""

import glob
import os
import shlex
import shutil
import subprocess
import sys

import environment
import parts
import pins
from common import PlatformError, SetupError, cache_dir, machine, say

CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
TARGET = "aarch64-unknown-linux-gnu"
SYSROOT = "/usr/aarch64-linux-gnu"
PACKAGES = ("gcc-aarch64-linux-gnu", "g++-aarch64-linux-gnu")
LINKER = "aarch64-linux-gnu-gcc"
BINFMT = "/proc/sys/fs/binfmt_misc"
DEBIAN_SUITE = "trixie"
DEBIAN_RUST = "1.96"
# QEMU 7.2 of the Debian before neither opens serial lines (TCGETS2) nor shows programs their own processor, which
# ONNX Runtime asks for.
DEBIAN_QEMU = "10.0"
# Debian's Python, which tries the wheel for aarch64.
DEBIAN_PYTHON = (
    "python3.13-minimal libpython3.13-minimal libpython3.13-stdlib libc6 libgcc-s1 libstdc++6 libexpat1 zlib1g libffi8 "
    "libssl3t64 libsqlite3-0 libbz2-1.0 liblzma5 libuuid1 libzstd1"
).split()
# Start of an ELF file for aarch64, and the bits of it that count.
ELF = r"\x7fELF\x02\x01\x01" + r"\x00" * 9 + r"\x02\x00\xb7\x00"
ELF_MASK = r"\xff" * 7 + r"\x00" + r"\xff" * 8 + r"\xfe\xff\xff\xff"
# What Debian's rustc needs to run on an older Debian.
DEBIAN_RUNS = (
    "libc6 libgcc-s1 libstdc++6 libllvm22 libedit2 libtinfo6 libxml2 libz3-4 libzstd1 zlib1g libffi8 libbsd0 libmd0 liblzma5"
).split()


def main() -> int:
    try:
        if machine() != "x86_64":
            raise PlatformError("this machine is an aarch64 itself: `make test` is what runs there")
        system()
        emulation()
        values = {
            "CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER": LINKER,
            "CARGO_TARGET_DIR": os.path.join(CHECKOUT, "target", "arm"),
            "CC_aarch64_unknown_linux_gnu": LINKER,
            "CXX_aarch64_unknown_linux_gnu": "aarch64-linux-gnu-g++",
            "QEMU_LD_PREFIX": SYSROOT,
            "QEMU_CPU": "cortex-a53",
        }
        rustc = rust()
        if rustc:
            values["RUSTC"] = rustc
        part = pins.ONNXRUNTIME["aarch64"]
        values["ORT_DYLIB_PATH"] = os.path.join(parts.provision(part), part.loads)
        # for what `make wheel-arm` builds: the learner, and the Python module against the stable interface
        values["LIBTORCH"] = parts.provision(pins.LIBTORCH["aarch64"])
        values["PYO3_NO_PYTHON"] = "1"
    except SetupError as error:
        say("arm: skipped, and with it what is tried for the robot's processor (%s)" % error)
        return error.exit_code
    path = os.path.join(CHECKOUT, ".cargo", "arm.sh")
    with open(path, "w", encoding="utf-8") as file:
        file.write("# Written by setup/arm.py.\n" + environment.exports(values))
    say("arm: ready, see %s" % path)
    return 0


def system() -> None:
    if shutil.which(LINKER):
        return
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        raise PlatformError("missing here, for root to install: " + " ".join(PACKAGES))
    say("arm: installing " + " ".join(PACKAGES))
    run("apt-get", "update")
    run("apt-get", "install", "-y", "--no-install-recommends", *PACKAGES)


def emulation() -> None:
    """The kernel must start aarch64 programs through QEMU, since the robot's program starts itself. Of several rules
    it takes the newest."""
    qemu = os.path.join(debian("qemu-%s" % DEBIAN_QEMU, ["qemu-user:amd64"]), "usr/bin/qemu-aarch64")
    if os.path.exists(os.path.join(BINFMT, "caudata-aarch64")):
        return
    try:
        if not os.path.exists(os.path.join(BINFMT, "register")):
            run("mount", "-t", "binfmt_misc", "none", BINFMT)
        with open(os.path.join(BINFMT, "register"), "w", encoding="ascii") as register:
            register.write(":caudata-aarch64:M::%s:%s:%s:OF" % (ELF, ELF_MASK, qemu))
    except OSError as error:
        raise PlatformError("the kernel does not start aarch64 programs, and %s" % error)


def rust() -> str:
    """The compiler to use, or nothing for the one that is there anyway."""
    if has_target("rustc"):
        return ""
    say("arm: no library of this Rust for %s, taking Debian's Rust %s" % (TARGET, DEBIAN_RUST))
    return debian_rust()


def has_target(rustc: str) -> bool:
    asked = subprocess.run([rustc, "--target", TARGET, "--print", "target-libdir"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    return asked.returncode == 0 and os.path.isdir(asked.stdout.decode().strip())


def debian_rust() -> str:
    here = ["rustc-web", "libstd-rust-web-%s" % DEBIAN_RUST, "libstd-rust-web-dev", *DEBIAN_RUNS]
    folder = debian("rust-%s" % DEBIAN_RUST, [name + ":amd64" for name in here] + ["libstd-rust-web-dev:arm64"])
    rustc = os.path.join(folder, "rustc")
    loader = os.path.join(folder, "usr/lib/x86_64-linux-gnu")
    script = '#!/bin/sh\nexec %s/ld-linux-x86-64.so.2 --library-path %s %s "$@"\n'
    write(rustc, script % tuple(map(shlex.quote, (loader, loader, os.path.join(folder, "usr/bin/rustc")))))
    os.chmod(rustc, 0o755)
    if not has_target(rustc):
        raise PlatformError("Debian's Rust in %s does not run here" % folder)
    return rustc


def debian(name: str, packages: list) -> str:
    """The folder in the cache with these packages of Debian, unpacked where they are not yet."""
    folder = os.path.join(cache_dir(), "debian-" + name)
    with parts.locked(cache_dir()):
        if not os.path.exists(folder):
            building = folder + ".tmp"
            shutil.rmtree(building, ignore_errors=True)
            unpack_debian(building, packages)
            os.rename(building, folder)
    return folder


def unpack_debian(into: str, packages: list) -> None:
    """Through apt, with folders of its own, so that this system's packages and lists stay as they are."""
    state = os.path.join(into, "apt")
    for name in ("state/lists/partial", "cache/archives/partial", "etc/sources.list.d"):
        os.makedirs(os.path.join(state, name))
    mirror = debian_mirror()
    keyring = "/usr/share/keyrings/debian-archive-keyring.gpg"
    write(os.path.join(state, "etc/sources.list"), "deb [signed-by=%s] %s %s main\n" % (keyring, mirror, DEBIAN_SUITE))
    write(os.path.join(state, "state/status"), "")
    write(
        os.path.join(state, "apt.conf"),
        'Dir::State "%s/state";\nDir::State::status "%s/state/status";\nDir::Cache "%s/cache";\nDir::Etc "%s/etc";\n'
        'APT::Architecture "amd64";\nAPT::Architectures { "amd64"; "arm64"; };\nAPT::Sandbox::User "root";\n' % ((state,) * 4),
    )
    apt = dict(os.environ, APT_CONFIG=os.path.join(state, "apt.conf"))
    run("apt-get", "update", env=apt)
    run("apt-get", "download", *packages, env=apt, cwd=state)
    for package in glob.glob(os.path.join(state, "*.deb")):
        run("dpkg", "-x", package, into)
    shutil.rmtree(state)


def debian_mirror() -> str:
    """The one that this system uses."""
    listed = subprocess.run(["apt-get", "indextargets", "--format", "$(SITE) $(LABEL)"], stdout=subprocess.PIPE, check=False)
    for line in listed.stdout.decode().splitlines():
        site = line.split()[0]
        if site.endswith("/debian"):
            return site
    raise PlatformError("this system's packages come from no Debian mirror: install a Rust with the target %s" % TARGET)


def write(path: str, text: str) -> None:
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)


def run(*command: str, **options) -> None:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, **options)
    if done.returncode != 0:
        lines = done.stdout.decode("utf-8", "replace").strip().splitlines() or ["no message"]
        raise PlatformError("`%s` failed: %s" % (" ".join(command), lines[-1]))


if __name__ == "__main__":
    sys.exit(main())
