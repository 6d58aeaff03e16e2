"""Downloads a pinned file: checked by hash, resumed after any break, bounded retries."""

import errno
import hashlib
import http.client
import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.error
from typing import NamedTuple, Optional

import index
from common import DiskError, HashError, NetworkError, megabytes, pip_environment, say
from pins import Wheel

CHUNK_BYTES = 1 << 20
PROGRESS_SECS = 5.0
# The fault is on this side: trying again would not help.
LOCAL_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EIO)


class Retry(NamedTuple):
    """An attempt that brought new bytes starts the count of fruitless ones again."""

    fruitless_max: int = 5
    total_max: int = 100
    first_wait_secs: float = 1.0
    wait_secs_max: float = 30.0


DEFAULT_RETRY = Retry()


class Broken(Exception):
    """One attempt failed; what arrived so far is kept."""


def fetch_wheel(wheel: Wheel, folder: str) -> str:
    """Returns the path of the verified wheel in `folder`, downloading what is missing of it."""
    retry = DEFAULT_RETRY
    path = os.path.join(folder, wheel.filename)
    if os.path.exists(path) and _matches(path, wheel):
        return path
    os.makedirs(folder, exist_ok=True)
    part = path + ".part"
    resumed = _size(part) > 0
    try:
        try:
            _fetch_over_http(wheel, part, retry)
        except NetworkError as error:
            say("own download of %s failed (%s); trying `pip download`" % (wheel.filename, error))
            _fetch_with_pip(wheel, part, error)
            resumed = False
        verified = _matches(part, wheel)
        if not verified and resumed:
            # The kept piece may come from a damaged disk or an older mirror: once more, from zero.
            say("starting %s again from zero" % wheel.filename)
            _fetch_over_http(wheel, part, retry)
            verified = _matches(part, wheel)
        if not verified:
            raise HashError(
                "%s %s as served by the package index does not have the pinned hash: the index or a proxy on the"
                " way alters files; point pip at another index and run this again" % (wheel.project, wheel.version)
            )
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskError(
                "no space left in %s while downloading %s (what arrived is kept): free some space or set"
                " XDG_CACHE_HOME to a larger disk, then run this again" % (folder, wheel.filename)
            )
        raise
    os.replace(part, path)
    return path


def remaining_bytes(wheel: Wheel, folder: str) -> int:
    path = os.path.join(folder, wheel.filename)
    return max(0, wheel.size - max(_size(path), _size(path + ".part")))


def sha256_of(path: str) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(CHUNK_BYTES), b""):
            digest.update(block)
    return digest.hexdigest()


def _matches(path: str, wheel: Wheel) -> bool:
    """Checks the hash; a file that fails is thrown away, never used and never resumed."""
    if not os.path.exists(path):
        return False
    found = sha256_of(path)
    if found == wheel.sha256:
        return True
    say("%s has the wrong hash (%s..., pinned %s...): thrown away" % (wheel.filename, found[:12], wheel.sha256[:12]))
    os.remove(path)
    return False


def _fetch_over_http(wheel: Wheel, part: str, retry: Retry) -> None:
    client: Optional[index.Client] = None
    link: Optional[index.Link] = None
    fruitless = 0
    for _ in range(retry.total_max):
        before = _size(part)
        if before == wheel.size:
            return
        try:
            # The address is looked up again after each break: mirrors sign addresses for minutes only.
            client = client or index.Client(index.pip_settings())
            link = link or index.find_file(client, wheel.project, wheel.filename, wheel.sha256)
            _continue_part(client, link.url, wheel, part)
            return
        except (Broken, NetworkError, urllib.error.URLError, http.client.HTTPException, OSError) as error:
            if isinstance(error, OSError) and error.errno in LOCAL_ERRNOS:
                raise
            link = None
            fruitless = 0 if _size(part) > before else fruitless + 1
            if fruitless >= retry.fruitless_max or _is_final(error):
                raise NetworkError(str(error))
            wait = min(retry.first_wait_secs * 2 ** max(0, fruitless - 1), retry.wait_secs_max)
            say(
                "%s broke off at %s of %s (%s); continuing in %.0f s"
                % (wheel.filename, megabytes(_size(part)), megabytes(wheel.size), error, wait)
            )
            time.sleep(wait)
    raise NetworkError("%s still incomplete after %d attempts" % (wheel.filename, retry.total_max))


def _is_final(error: Exception) -> bool:
    """Answers that waiting does not change: refused, not found, not listed."""
    refused = isinstance(error, urllib.error.HTTPError) and error.code in index.FINAL_HTTP_CODES
    return refused or isinstance(error, index.NotListed)


def _continue_part(client: index.Client, url: str, wheel: Wheel, part: str) -> None:
    have = _size(part)
    if have > wheel.size:
        os.remove(part)
        have = 0
    headers = {"Range": "bytes=%d-" % have} if have else {}
    try:
        response = client.open(url, headers)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # the server's file is shorter than our piece, so our piece is not of this file
            os.remove(part)
            raise Broken("the server cannot continue at %d bytes, starting from zero" % have)
        raise
    with response:
        start = _start_of(response)
        if start not in (0, have):
            raise Broken("the server answered with another range")
        if have and start == 0:
            say("the server does not continue downloads: %s starts from zero" % wheel.filename)
        with open(part, "ab" if start else "wb", buffering=0) as file:  # what arrived survives a kill
            _copy(response, file, start, wheel)
    if _size(part) < wheel.size:
        raise Broken("connection closed early")


def _start_of(response) -> int:
    if response.status != 206:
        return 0
    match = re.match(r"bytes (\d+)-", response.headers.get("Content-Range") or "")
    return int(match.group(1)) if match else -1


def _copy(response, file, start: int, wheel: Wheel) -> None:
    done, began, last = start, time.monotonic(), time.monotonic()
    if wheel.size > 20e6:
        say("%s: %s of %s" % (wheel.filename, megabytes(done), megabytes(wheel.size)))
    while done <= wheel.size:
        block = response.read1(CHUNK_BYTES)
        if not block:
            return
        file.write(block)
        done += len(block)
        now = time.monotonic()
        if now - last >= PROGRESS_SECS:
            last = now
            rate = (done - start) / (now - began)
            left = (wheel.size - done) / max(rate, 1.0)
            say(
                "%s: %s of %s, %s/s, %d:%02d left"
                % (wheel.filename, megabytes(done), megabytes(wheel.size), megabytes(rate), left // 60, left % 60)
            )


def _fetch_with_pip(wheel: Wheel, part: str, first_error: Exception) -> None:
    """The user's pip may know ways that we do not: keyrings, local folders, company proxies."""
    with tempfile.TemporaryDirectory(dir=os.path.dirname(part)) as scratch:
        requirement = os.path.join(scratch, "requirement.txt")
        with open(requirement, "w") as file:
            file.write("%s==%s --hash=sha256:%s\n" % (wheel.project, wheel.version, wheel.sha256))
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-cache-dir"]
        command += ["--require-hashes", "--only-binary=:all:", "--dest", scratch, "--requirement", requirement]
        command += ["--implementation", "cp", "--python-version", "311", "--abi", "cp311", "--abi", "none"]
        for tag in wheel.filename[: -len(".whl")].split("-")[-1].split("."):
            command += ["--platform", tag]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=pip_environment())
        got = os.path.join(scratch, wheel.filename)
        if done.returncode == 0 and os.path.exists(got):
            os.replace(got, part)
            return
    text = done.stderr.decode("utf-8", "replace")
    if "No space left" in text:
        raise OSError(errno.ENOSPC, "no space left")
    errors = [line for line in text.splitlines() if line.startswith("ERROR")] or ["ERROR: no message"]
    raise NetworkError(
        "cannot download %s %s (%s; pip: %s): check the network and pip's index settings (`pip config list`), then run"
        " this again, it continues where it stopped"
        % (wheel.project, wheel.version, first_error, errors[-1][len("ERROR: ") :])
    )


def _size(path: str) -> int:
    try:
        return os.path.getsize(path)
    except OSError:
        return 0
