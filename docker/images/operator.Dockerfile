# `caudata` and kubectl with a shell: what renews certificates in a cluster (docker/kubernetes/components/renew).
ARG BUILD=caudata/build
ARG BASE=docker.io/library/debian:bookworm-slim
ARG KUBECTL=registry.k8s.io/kubectl:v1.31.4
FROM ${KUBECTL} AS kubectl
FROM ${BUILD} AS build

FROM ${BASE}
COPY --from=kubectl /bin/kubectl /usr/local/bin/
COPY --from=build /out/bin/caudata /usr/local/bin/
USER 65532:65532
ENV HOME=/tmp
ENTRYPOINT ["/usr/local/bin/caudata"]
