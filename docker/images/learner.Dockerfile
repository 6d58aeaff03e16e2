# The learner: libtorch and ONNX Runtime. The run folder is a volume at /var/lib/caudata. For a GPU: learner-cuda.Dockerfile.
ARG BUILD=caudata/build
ARG BASE=docker.io/library/debian:bookworm-slim
FROM ${BUILD} AS build

FROM ${BASE} AS root
COPY --from=build /out/bin/caudata-learner /out/lib/libonnxruntime.so /in/
COPY --from=build /out/libtorch/ /opt/caudata/libtorch/
COPY docker/images/root.sh /in/
ENV LD_LIBRARY_PATH=/opt/caudata/libtorch
RUN sh -c 'ldconfig -p | grep -q libstdc++ || { apt-get update && apt-get install --yes --no-install-recommends libstdc++6; }' \
    && mkdir -p /root-fs/opt/caudata/lib && cp /in/libonnxruntime.so /root-fs/opt/caudata/lib/ \
    && cp -r /opt/caudata/libtorch /root-fs/opt/caudata/ \
    && sh /in/root.sh /root-fs /in/caudata-learner /in/libonnxruntime.so /opt/caudata/libtorch/*.so* \
    && mkdir -p /root-fs/var/lib/caudata && chown 65532:65532 /root-fs/var/lib/caudata

FROM scratch
COPY --from=root /root-fs/ /
COPY --from=build /out/robots/ /opt/caudata/robots/
ENV ORT_DYLIB_PATH=/opt/caudata/lib/libonnxruntime.so
ENV LD_LIBRARY_PATH=/opt/caudata/libtorch
WORKDIR /opt/caudata
USER 65532:65532
VOLUME /var/lib/caudata
EXPOSE 7447/udp 9464
STOPSIGNAL SIGTERM
ENTRYPOINT ["/usr/local/bin/caudata-learner"]
