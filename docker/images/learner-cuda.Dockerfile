# The learner on an NVIDIA GPU: that of learner.Dockerfile with the CUDA build of the same libtorch, out of PyTorch's wheel. x86-64; 4 GB.
#
#   docker/images/build.sh learner-cuda
ARG BUILD=caudata/build
ARG BASE=docker.io/library/debian:bookworm-slim
ARG PYTHON=docker.io/library/python:3.12-slim-bookworm
FROM ${BUILD} AS build

FROM ${PYTHON} AS torch
# The version that the learner is compiled against (setup/pins.py), with what it asks for of CUDA.
ARG TORCH=2.11.0
RUN pip install --no-cache-dir --only-binary=:all: --target /torch "torch==${TORCH}"
# Libraries find each other by paths from their own, so that folders keep their places.
RUN mkdir -p /out && cd /torch && cp -r --parents torch/lib nvidia/*/lib /out/ && rm -f /out/torch/lib/libtorch.so /out/torch/lib/libtorch_python.so

FROM ${BASE}
COPY --from=torch /out/ /opt/caudata/
COPY --from=build /out/bin/caudata-learner /usr/local/bin/
COPY --from=build /out/lib/libonnxruntime.so /opt/caudata/lib/
COPY --from=build /out/robots/ /opt/caudata/robots/
RUN mkdir -p /var/lib/caudata && chown 65532:65532 /var/lib/caudata
ENV ORT_DYLIB_PATH=/opt/caudata/lib/libonnxruntime.so
ENV LD_LIBRARY_PATH=/opt/caudata/torch/lib
# The learner finds CUDA when this is loaded first (docs/reference/learning.md).
ENV LD_PRELOAD=/opt/caudata/torch/lib/libtorch_cuda.so
# What NVIDIA's container runtime puts in.
ENV NVIDIA_VISIBLE_DEVICES=all
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /opt/caudata
USER 65532:65532
VOLUME /var/lib/caudata
EXPOSE 7447/udp 9464
STOPSIGNAL SIGTERM
ENTRYPOINT ["/usr/local/bin/caudata-learner"]
