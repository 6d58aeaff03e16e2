# An actor: one executable, ONNX Runtime, the robot. No libtorch, no shell, no package manager.
ARG BUILD=caudata/build
ARG BASE=docker.io/library/debian:bookworm-slim
FROM ${BUILD} AS build

FROM ${BASE} AS root
COPY --from=build /out/bin/caudata-actor /out/lib/libonnxruntime.so /in/
COPY docker/images/root.sh /in/
# libstdc++ comes with the base or with g++'s runtime package.
RUN sh -c 'ldconfig -p | grep -q libstdc++ || { apt-get update && apt-get install --yes --no-install-recommends libstdc++6; }' \
    && mkdir -p /root-fs/opt/caudata/lib && cp /in/libonnxruntime.so /root-fs/opt/caudata/lib/ \
    && sh /in/root.sh /root-fs /in/caudata-actor /in/libonnxruntime.so

FROM scratch
COPY --from=root /root-fs/ /
COPY --from=build /out/robots/ /opt/caudata/robots/
ENV ORT_DYLIB_PATH=/opt/caudata/lib/libonnxruntime.so
WORKDIR /opt/caudata
USER 65532:65532
EXPOSE 9464
STOPSIGNAL SIGTERM
ENTRYPOINT ["/usr/local/bin/caudata-actor"]
