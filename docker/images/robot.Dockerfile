# The robot client for the robot's board (64-bit ARM), cross-compiled: the board itself is too small to compile on.
#
#   docker build -f docker/images/robot.Dockerfile -t caudata/robot --output type=local,dest=robot .
#
# gives the folder `robot/` to copy to the board; there it runs under systemd (docker/systemd/), not in a container, because it
# needs the serial port, real-time priority and little memory.
ARG RUST=docker.io/library/rust:1.95-bookworm
FROM ${RUST} AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc-aarch64-linux-gnu libc6-dev-arm64-cross python3 python3-pip \
    && rm -rf /var/lib/apt/lists/* && rustup target add aarch64-unknown-linux-gnu
WORKDIR /src
COPY . .
ENV CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
RUN cargo build --release --locked --target aarch64-unknown-linux-gnu -p caudata-deploy \
    && mkdir -p /robot/bin /robot/lib \
    && aarch64-linux-gnu-strip -o /robot/bin/caudata-robot target/aarch64-unknown-linux-gnu/release/caudata-robot
# The same version of ONNX Runtime as everywhere (setup/), its library for this processor out of the wheel.
ARG ONNXRUNTIME=1.31.1
RUN pip download --no-deps --only-binary=:all: --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 \
        --python-version 3.11 --dest /tmp/wheel "onnxruntime==${ONNXRUNTIME}" \
    && python3 -m zipfile -e /tmp/wheel/*.whl /tmp/wheel/out \
    && cp /tmp/wheel/out/onnxruntime/capi/libonnxruntime.so.* /robot/lib/libonnxruntime.so
RUN cp -r robots /robot/robots && mkdir -p /robot/share && cp policies/flat.onnx /robot/share/factory.onnx

FROM scratch
COPY --from=build /robot/ /
