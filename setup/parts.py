"""Turns pinned wheels into a finished folder of the cache, and knows whether one is intact.

A folder appears by one rename, complete and with its stamp, so a killed run leaves either nothing or
a finished part; several checkouts and several runs at once share it.
"""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from typing import Iterator, List, Tuple

import download
from common import CacheError, DiskError, HashError, PlatformError, cache_dir, machine, megabytes, say
from pins import MIN_GLIBC, Part, Wheel

STAMP = "stamp.json"
DISK_RESERVE_BYTES = 50_000_000


def provision(part: Part, verify: bool = False) -> str:
    """Returns the folder of the part, making it first where it is missing or damaged."""
    folder = os.path.join(cache_dir(), part.folder)
    if is_intact(part, folder, verify):
        return folder
    with locked(cache_dir()):
        if is_intact(part, folder, verify):  # another run made it while this one waited
            return folder
        _remove_leftovers(part)
        _make(part, folder)
    return folder


def is_intact(part: Part, folder: str, verify: bool = False) -> bool:
    """Cheap by default: the pins, and every file's name and size. `verify` also hashes the libraries."""
    try:
        with open(os.path.join(folder, STAMP)) as file:
            stamp = json.load(file)
        if stamp["recipe"] != recipe_digest(part) or stamp["tree"] != tree_digest(folder):
            return False
        return not verify or all(
            download.sha256_of(os.path.join(folder, path)) == sha256 for path, sha256 in stamp["libraries"].items()
        )
    except (OSError, ValueError, KeyError):
        return False


def recipe_digest(part: Part) -> str:
    return hashlib.sha256(repr(part).encode("utf-8")).hexdigest()


def tree_digest(folder: str) -> str:
    lines = []
    for here, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(here, name)
            relative = os.path.relpath(path, folder)
            if relative != STAMP:
                lines.append("%s %d" % (relative, os.stat(path).st_size))
    return hashlib.sha256("\n".join(sorted(lines)).encode("utf-8")).hexdigest()


@contextlib.contextmanager
def locked(folder: str) -> Iterator[None]:
    """One set-up at a time per cache. The kernel drops the lock when a run dies, so none is ever stale."""
    try:
        os.makedirs(folder, exist_ok=True)
        lock = open(os.path.join(folder, ".lock"), "w")
    except OSError as error:
        raise CacheError("cannot write to the cache %s (%s): set XDG_CACHE_HOME to a folder of yours" % (folder, error))
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise CacheError(
                    "cannot lock the cache %s (%s): set XDG_CACHE_HOME to a local disk" % (folder, error.strerror)
                )
            say("another set-up is at work in %s, waiting for it" % folder)
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _make(part: Part, folder: str) -> None:
    downloads = os.path.join(cache_dir(), "downloads")
    _check_disk(part, downloads)
    say("%s: making %s" % (part.name, folder))
    wheels = [(wheel, download.fetch_wheel(wheel, downloads)) for wheel in part.wheels]
    building = "%s.tmp-%d" % (folder, os.getpid())
    try:
        _assemble(part, wheels, building)
        _check_loads(part, building)
    except BaseException as error:
        shutil.rmtree(building, ignore_errors=True)
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskError(
                "no space left in %s while unpacking %s: free some space or set XDG_CACHE_HOME to a larger disk,"
                " then run this again" % (cache_dir(), part.name)
            )
        raise
    if os.path.exists(folder):
        os.rename(folder, "%s.old-%d" % (folder, os.getpid()))
    os.rename(building, folder)
    _remove_leftovers(part)
    for _, path in wheels:
        os.remove(path)
    say("%s: ready in %s" % (part.name, folder))


def _check_disk(part: Part, downloads: str) -> None:
    missing = sum(download.remaining_bytes(wheel, downloads) for wheel in part.wheels)
    needed = missing + part.unpacked_size + DISK_RESERVE_BYTES
    free = shutil.disk_usage(cache_dir()).free
    if free < needed:
        raise DiskError(
            "%s needs %s in %s, where %s is free: free some space or set XDG_CACHE_HOME to a larger disk"
            % (part.name, megabytes(needed), cache_dir(), megabytes(free))
        )


def _assemble(part: Part, wheels: List[Tuple[Wheel, str]], building: str) -> None:
    shutil.rmtree(building, ignore_errors=True)
    os.makedirs(building)
    for wheel, path in wheels:
        say("%s: unpacking %s" % (part.name, wheel.filename))
        with zipfile.ZipFile(path) as archive:
            for source, target in _selected(archive.namelist(), wheel):
                _extract(archive, source, os.path.join(building, target))
    for target, text in part.texts:
        _write(os.path.join(building, target), text)
    stamp = {
        "recipe": recipe_digest(part),
        "wheels": {wheel.filename: wheel.sha256 for wheel, _ in wheels},
        "libraries": {path: download.sha256_of(os.path.join(building, path)) for path in part.libraries},
        "tree": tree_digest(building),
    }
    _write(os.path.join(building, STAMP), json.dumps(stamp, indent=1) + "\n")


def _selected(names: List[str], wheel: Wheel) -> List[Tuple[str, str]]:
    """Pairs of (name in the wheel, path in the part) for the members the pin asks for."""
    selected = []
    for source, target in wheel.members:
        if source.endswith("/"):
            found = [(n, target + n[len(source) :]) for n in names if n.startswith(source) and not n.endswith("/")]
        else:
            found = [(n, target) for n in names if n == source]
        if not found or any(".." in path.split("/") for _, path in found):
            raise HashError("%s does not hold %s as expected: correct setup/pins.py" % (wheel.filename, source))
        selected += found
    return selected


def _extract(archive: zipfile.ZipFile, source: str, target: str) -> None:
    os.makedirs(os.path.dirname(target), exist_ok=True)
    with archive.open(source) as packed, open(target, "wb") as file:
        shutil.copyfileobj(packed, file, 1 << 20)


def _write(path: str, text: str) -> None:
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w") as file:
        file.write(text)


def _check_loads(part: Part, folder: str) -> None:
    """Loads the library once, in a process of its own, so that an old system says so here and not at link time.
    One of another processor cannot be tried."""
    if not part.folder.endswith(machine()):
        return
    code = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"
    library = os.path.join(folder, part.loads)
    done = subprocess.run([sys.executable, "-c", code, library], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    if done.returncode != 0:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise PlatformError(
            "%s does not load here (%s): it needs glibc %s or newer and libstdc++6"
            % (part.name, lines[-1] if lines else "exit status %d" % done.returncode, MIN_GLIBC)
        )


def _remove_leftovers(part: Part) -> None:
    """Half-made and replaced folders of this part, of killed runs too. Call under the lock."""
    for name in os.listdir(cache_dir()):
        if name.startswith((part.folder + ".tmp-", part.folder + ".old-")):
            shutil.rmtree(os.path.join(cache_dir(), name), ignore_errors=True)
