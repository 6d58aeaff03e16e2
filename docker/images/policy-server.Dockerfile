# The policy server: one executable. The store is a volume at /var/lib/caudata.
ARG BUILD=caudata/build
ARG BASE=docker.io/library/debian:bookworm-slim
FROM ${BUILD} AS build

FROM ${BASE} AS root
COPY --from=build /out/bin/caudata-policy-server /in/
COPY docker/images/root.sh /in/
RUN sh /in/root.sh /root-fs /in/caudata-policy-server \
    && mkdir -p /root-fs/var/lib/caudata && chown 65532:65532 /root-fs/var/lib/caudata

FROM scratch
COPY --from=root /root-fs/ /
USER 65532:65532
VOLUME /var/lib/caudata
EXPOSE 7401 9464
STOPSIGNAL SIGTERM
ENTRYPOINT ["/usr/local/bin/caudata-policy-server"]
CMD ["--data", "/var/lib/caudata", "--addr", "0.0.0.0:7401"]
