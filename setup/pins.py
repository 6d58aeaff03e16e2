"""What set-up provisions: exact versions, file names, hashes and sizes.

The libraries are taken out of Python wheels because every package index serves those, mirrors
included. No Python runs the result. The wheels' Python tag is fixed (cp311), so each host gets the
same bytes whatever its own Python is. To move to another version, change the entries here: the
folder name carries the version, and a stamp in the folder carries a digest of the whole entry.
"""

from typing import Dict, NamedTuple, Tuple

LIBTORCH_VERSION = "2.11.0"  # the version that tch 0.24 wants
ONNXRUNTIME_VERSION = "1.31.1"  # serves API level 31, the highest that ort 2.0.0-rc.15 knows
# The oldest library that our build of `ort` accepts: its feature api-NN in Cargo.toml, 17 without one.
ONNXRUNTIME_MIN_MINOR = 31
PYARROW_VERSION = "22.0.0"
MUJOCO_VERSION = "3.17.0"  # the newest with wheels for all of Python 3.10 to 3.14
RCLPY_VERSION = "9.1.2"  # ROS 2 Kilted as Python wheels, Linux x86-64, CPython 3.11 to 3.13
MIN_GLIBC = "2.28"  # the wheels are manylinux_2_28


class Wheel(NamedTuple):
    """One pinned file of the package index, and what is taken out of it."""

    project: str
    version: str
    filename: str
    sha256: str
    size: int  # bytes
    members: Tuple[Tuple[str, str], ...]  # (path in the wheel, path in the part); "dir/" takes the tree


class Part(NamedTuple):
    """One provisioned folder of the cache."""

    name: str
    folder: str
    wheels: Tuple[Wheel, ...]
    texts: Tuple[Tuple[str, str], ...]  # small files that we write ourselves
    unpacked_size: int  # bytes, for the disk check
    libraries: Tuple[str, ...]  # hashed into the stamp, compared by --verify
    loads: str  # the library that must load on this machine


# libtorch without CUDA out of the CUDA wheel: libtorch_cpu.so needs libcupti and libcudart to load,
# nothing more of CUDA. torch-sys links `-ltorch`; the wheel's own libtorch.so would pull in the
# CUDA library, hence the one-line linker script in its place.
_TORCH_TEXTS = (
    ("lib/libtorch.so", "INPUT(-ltorch_cpu)\n"),
    ("build-version", LIBTORCH_VERSION + "\n"),
)
_TORCH_COMMON = (
    ("torch/lib/libc10.so", "lib/libc10.so"),
    ("torch/lib/libtorch_cpu.so", "lib/libtorch_cpu.so"),
    ("torch/lib/libgomp.so.1", "lib/libgomp.so.1"),
    ("torch/include/", "include/"),
    ("torch-2.11.0.dist-info/licenses/", "licenses/torch/"),
)
# The aarch64 build also needs NVIDIA's CPU BLAS and Arm's compute library, all inside its wheel.
_TORCH_AARCH64 = tuple(
    ("torch/lib/" + so, "lib/" + so)
    for so in (
        "libarm_compute.so",
        "libarm_compute_graph.so",
        "libnvpl_blas_core.so.0",
        "libnvpl_blas_lp64_gomp.so.0",
        "libnvpl_lapack_core.so.0",
        "libnvpl_lapack_lp64_gomp.so.0",
    )
)
_CUPTI = (
    ("nvidia/cu13/lib/libcupti.so.13", "lib/libcupti.so.13"),
    ("nvidia_cuda_cupti-13.0.85.dist-info/licenses/", "licenses/cupti/"),
)
_CUDART = (
    ("nvidia/cu13/lib/libcudart.so.13", "lib/libcudart.so.13"),
    ("nvidia_cuda_runtime-13.0.96.dist-info/licenses/", "licenses/cudart/"),
)
_ONNXRUNTIME = (
    ("onnxruntime/capi/libonnxruntime.so.1.31.1", "lib/libonnxruntime.so"),
    ("onnxruntime/LICENSE", "LICENSE"),
    ("onnxruntime/ThirdPartyNotices.txt", "ThirdPartyNotices.txt"),
)
_TORCH_LIBRARIES = (
    "lib/libc10.so",
    "lib/libtorch_cpu.so",
    "lib/libgomp.so.1",
    "lib/libcupti.so.13",
    "lib/libcudart.so.13",
)

LIBTORCH: Dict[str, Part] = {
    "x86_64": Part(
        name="libtorch",
        folder="libtorch-2.11.0-cpu-x86_64",
        wheels=(
            Wheel(
                "torch", "2.11.0",
                "torch-2.11.0-cp311-cp311-manylinux_2_28_x86_64.whl",
                "7aa2f9bbc6d4595ba72138026b2074be1233186150e9292865e04b7a63b8c67a",
                530604548, _TORCH_COMMON,
            ),
            Wheel(
                "nvidia-cuda-cupti", "13.0.85",
                "nvidia_cuda_cupti-13.0.85-py3-none-manylinux_2_25_x86_64.whl",
                "4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8",
                10715597, _CUPTI,
            ),
            Wheel(
                "nvidia-cuda-runtime", "13.0.96",
                "nvidia_cuda_runtime-13.0.96-py3-none-manylinux2014_x86_64.manylinux_2_17_x86_64.whl",
                "7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548",
                2243632, _CUDART,
            ),
        ),
        texts=_TORCH_TEXTS,
        unpacked_size=530_000_000,
        libraries=_TORCH_LIBRARIES,
        loads="lib/libtorch_cpu.so",
    ),
    "aarch64": Part(
        name="libtorch",
        folder="libtorch-2.11.0-cpu-aarch64",
        wheels=(
            Wheel(
                "torch", "2.11.0",
                "torch-2.11.0-cp311-cp311-manylinux_2_28_aarch64.whl",
                "d91aac77f24082809d2c5a93f52a5f085032740a1ebc9252a7b052ef5a4fddc6",
                419718178, _TORCH_COMMON + _TORCH_AARCH64,
            ),
            Wheel(
                "nvidia-cuda-cupti", "13.0.85",
                "nvidia_cuda_cupti-13.0.85-py3-none-manylinux_2_25_aarch64.whl",
                "796bd679890ee55fb14a94629b698b6db54bcfd833d391d5e94017dd9d7d3151",
                10310827, _CUPTI,
            ),
            Wheel(
                "nvidia-cuda-runtime", "13.0.96",
                "nvidia_cuda_runtime-13.0.96-py3-none-manylinux2014_aarch64.manylinux_2_17_aarch64.whl",
                "ef9bcbe90493a2b9d810e43d249adb3d02e98dd30200d86607d8d02687c43f55",
                2261060, _CUDART,
            ),
        ),
        texts=_TORCH_TEXTS,
        unpacked_size=380_000_000,
        libraries=_TORCH_LIBRARIES + tuple(path for _, path in _TORCH_AARCH64),
        loads="lib/libtorch_cpu.so",
    ),
}

ONNXRUNTIME: Dict[str, Part] = {
    "x86_64": Part(
        name="ONNX Runtime",
        folder="onnxruntime-1.31.1-x86_64",
        wheels=(
            Wheel(
                "onnxruntime", "1.31.1",
                "onnxruntime-1.31.1-cp311-cp311-manylinux_2_28_x86_64.whl",
                "5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f",
                23753652, _ONNXRUNTIME,
            ),
        ),
        texts=(),
        unpacked_size=30_000_000,
        libraries=("lib/libonnxruntime.so",),
        loads="lib/libonnxruntime.so",
    ),
    "aarch64": Part(
        name="ONNX Runtime",
        folder="onnxruntime-1.31.1-aarch64",
        wheels=(
            Wheel(
                "onnxruntime", "1.31.1",
                "onnxruntime-1.31.1-cp311-cp311-manylinux_2_28_aarch64.whl",
                "da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3",
                21413526, _ONNXRUNTIME,
            ),
        ),
        texts=(),
        unpacked_size=26_000_000,
        libraries=("lib/libonnxruntime.so",),
        loads="lib/libonnxruntime.so",
    ),
}
