"""Checks a libtorch or an ONNX Runtime that the user brings along, so that a wrong path fails here."""

import ctypes
import os

from common import UserPathError
from pins import LIBTORCH_VERSION, ONNXRUNTIME_MIN_MINOR

_LIBTORCH_FILES = (
    "include/torch/csrc/api/include/torch/torch.h",
    "lib/libtorch.so",
    "lib/libtorch_cpu.so",
    "lib/libc10.so",
)


def check_libtorch(folder: str) -> None:
    """The same conditions that torch-sys has, LIBTORCH_INCLUDE, LIBTORCH_LIB and the bypass included."""
    for path in _LIBTORCH_FILES:
        override = "LIBTORCH_INCLUDE" if path.startswith("include/") else "LIBTORCH_LIB"
        base = os.environ.get(override) or folder
        if not os.path.exists(os.path.join(base, path)):
            raise UserPathError(
                "LIBTORCH=%s lacks %s (looked in %s): set it to an unpacked libtorch %s, or unset it to have one"
                " downloaded" % (folder, path, base, LIBTORCH_VERSION)
            )
    version = _libtorch_version(folder)
    if version and version != LIBTORCH_VERSION and "LIBTORCH_BYPASS_VERSION_CHECK" not in os.environ:
        raise UserPathError(
            "LIBTORCH=%s is version %s, not %s: set it to that version, unset it, or set LIBTORCH_BYPASS_VERSION_CHECK=1"
            % (folder, version, LIBTORCH_VERSION)
        )


def _libtorch_version(folder: str) -> str:
    try:
        with open(os.path.join(folder, "build-version")) as file:
            return file.read().strip().split("+")[0]
    except OSError:
        return ""  # the `torch` folder of a Python environment has no such file


def check_onnxruntime(library: str) -> None:
    if not os.path.isfile(library):
        raise UserPathError(
            "ORT_DYLIB_PATH=%s is not a file: set it to a libonnxruntime.so, or unset it to have one downloaded"
            % library
        )
    try:
        version = onnxruntime_version(library)
    except (OSError, AttributeError) as error:
        raise UserPathError(
            "ORT_DYLIB_PATH=%s cannot be used (%s): set it to a libonnxruntime.so for this machine, or unset it"
            % (library, error)
        )
    if int(version.split(".")[1]) < ONNXRUNTIME_MIN_MINOR:
        raise UserPathError(
            "ORT_DYLIB_PATH=%s is version %s, but 1.%d or newer is needed: set it to a newer one, or unset it"
            % (library, version, ONNXRUNTIME_MIN_MINOR)
        )


class _OrtApiBase(ctypes.Structure):
    _fields_ = [("get_api", ctypes.c_void_p), ("get_version_string", ctypes.CFUNCTYPE(ctypes.c_char_p))]


def onnxruntime_version(library: str) -> str:
    get_base = ctypes.CDLL(os.path.abspath(library)).OrtGetApiBase
    get_base.restype = ctypes.POINTER(_OrtApiBase)
    return get_base().contents.get_version_string().decode("ascii")
