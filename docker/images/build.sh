#!/bin/sh
# Builds the images:  docker/images/build.sh [--prebuilt] [--push] [actor|policy-server|learner|learner-cuda|operator ...]
#
# Without names the first three.
# --prebuilt takes the executables out of target/release instead of compiling in a container.
# --push sends each to the registry that IMAGES names, for instance IMAGES=registry.example.org/lab.
# ENGINE: docker (default), podman, or buildah; BASE: the Debian image; IMAGES, TAG: of the results (caudata, latest).
# BUILDAH_FLAGS, BUD_FLAGS: for a machine without a container engine, `--storage-driver vfs` and `--isolation chroot`.
set -eu
cd "$(dirname "$0")/../.."
ENGINE=${ENGINE:-docker}
BASE=${BASE:-docker.io/library/debian:bookworm-slim}
IMAGES=${IMAGES:-caudata}
TAG=${TAG:-latest}
build() { # FILE IMAGE CONTEXT
    case $ENGINE in
        # shellcheck disable=SC2086
        buildah) buildah ${BUILDAH_FLAGS:-} bud ${BUD_FLAGS:-} --build-arg "BASE=$BASE" --build-arg "BUILD=$IMAGES/build:$TAG" -f "$1" -t "$2:$TAG" "$3" ;;
        *) "$ENGINE" build --build-arg "BASE=$BASE" --build-arg "BUILD=$IMAGES/build:$TAG" -f "$1" -t "$2:$TAG" "$3" ;;
    esac
}
prebuilt='' push=''
while :; do
    case ${1:-} in
        --prebuilt) prebuilt=1 ;;
        --push) push=1 ;;
        *) break ;;
    esac
    shift
done
if [ -n "$prebuilt" ]; then
    out=$(mktemp -d)
    trap 'rm -rf "$out"' EXIT
    docker/images/collect.sh "${TARGET_DIR:-target/release}" "$out"
    build docker/images/prebuilt.Dockerfile "$IMAGES/build" "$out"
else
    build docker/images/build.Dockerfile "$IMAGES/build" .
fi
[ $# -gt 0 ] || set -- actor policy-server learner
for name in "$@"; do
    build "docker/images/$name.Dockerfile" "$IMAGES/$name" .
    # shellcheck disable=SC2086
    [ -z "$push" ] || "$ENGINE" ${BUILDAH_FLAGS:-} push "$IMAGES/$name:$TAG"
done
