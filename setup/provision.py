#!/usr/bin/env python3
"""Provisions libtorch, ONNX Runtime and, for tests, MuJoCo and ROS 2. Needs only Python 3.8 and pip.

The files go to ${XDG_CACHE_HOME:-~/.cache}/caudata and are shared by all checkouts. LIBTORCH and
ORT_DYLIB_PATH, where set, are checked and used instead. Exit status: 0 done, 2 usage, 10 network,
11 wrong hash, 12 disk, 13 user's path, 14 platform, 15 cache, 16 pip, 130 interrupted.
"""

import argparse
import os
import sys
from typing import Dict, List, Optional

if sys.version_info < (3, 8):
    sys.exit("setup: error: Python 3.8 or newer is needed, this is %s" % sys.version.split()[0])

import environment
import parts
import pins
import python_env
import user_paths
from common import CacheError, SetupError, cache_dir, machine, say

CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def main(arguments: Optional[List[str]] = None) -> int:
    options = parse(arguments)
    try:
        values = provision(options)
    except SetupError as error:
        say("error: %s" % error)
        return error.exit_code
    except OSError as error:
        say("error: %s (the cache is %s): correct that, then run this again" % (error, cache_dir()))
        return CacheError.exit_code
    except KeyboardInterrupt:
        say("interrupted; the next run continues from here")
        return 130
    if options.print_env:
        sys.stdout.write(environment.exports(values))
    return 0


def parse(arguments: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="setup/provision.py", description=__doc__)
    parser.add_argument("--with-mujoco", action="store_true", help="also MuJoCo and pyarrow, which only tests use")
    parser.add_argument("--with-ros2", action="store_true", help="also ROS 2, which only the long tests use")
    parser.add_argument("--print-env", action="store_true", help="print export lines for a shell on standard output")
    parser.add_argument("--verify", action="store_true", help="hash the provisioned libraries again, not only sizes")
    parser.add_argument("--checkout", default=CHECKOUT, help="where .cargo/ is written (default: this checkout)")
    return parser.parse_args(arguments)


def provision(options: argparse.Namespace) -> Dict[str, str]:
    values = {
        "LIBTORCH": libtorch(options.verify),
        "ORT_DYLIB_PATH": onnxruntime(options.verify),
        # The Python module is built against the stable interface; whatever Python this machine has is not asked.
        "PYO3_NO_PYTHON": "1",
    }
    environments = (
        (python_env.MUJOCO, options.with_mujoco),
        (python_env.RECORDINGS, options.with_mujoco),
        (python_env.ROS2, options.with_ros2),
    )
    for wanted, asked_for in environments:
        python = python_env.provision(wanted) if asked_for else python_env.ready(wanted)
        if python:
            values[wanted.variable] = python
    environment.write(options.checkout, values)
    return values


def libtorch(verify: bool) -> str:
    users = users_own("LIBTORCH")
    if users:
        user_paths.check_libtorch(users)
        return users
    return parts.provision(pins.LIBTORCH[machine()], verify)


def onnxruntime(verify: bool) -> str:
    users = users_own("ORT_DYLIB_PATH")
    if users:
        user_paths.check_onnxruntime(users)
        return users
    part = pins.ONNXRUNTIME[machine()]
    return os.path.join(parts.provision(part, verify), part.loads)


def users_own(variable: str) -> Optional[str]:
    """The variable's path unless it leads into our cache, where an earlier run's exports lead."""
    value = os.environ.get(variable)
    if not value:
        return None
    path = os.path.abspath(os.path.expanduser(value))
    return None if path.startswith(cache_dir() + os.sep) else path


if __name__ == "__main__":
    sys.exit(main())
