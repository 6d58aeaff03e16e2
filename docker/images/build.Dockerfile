# Compiles everything from the checkout and lays out what the other images take.
#
#   docker build -f docker/images/build.Dockerfile -t caudata/build .
#
# Where the binaries are built already, prebuilt.sh makes the same image from target/release without compiling.
ARG RUST=docker.io/library/rust:1.95-bookworm
FROM ${RUST}
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ make python3 python3-pip \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY . .
RUN make build && docker/images/collect.sh /src/target/release /out
