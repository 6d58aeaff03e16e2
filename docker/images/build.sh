#!/bin/sh
# Builds the images:  docker/images/build.sh [--prebuilt] [actor|policy-server|learner ...]
#
# --prebuilt takes the executables out of target/release instead of compiling in a container.
# ENGINE: docker (default), podman, or buildah; BASE: the Debian image; TAG: of the results (latest).
# BUILDAH_FLAGS, BUD_FLAGS: for a machine without a container engine, `--storage-driver vfs` and `--isolation chroot`.
set -eu
cd "$(dirname "$0")/../.."
ENGINE=${ENGINE:-docker}
BASE=${BASE:-docker.io/library/debian:bookworm-slim}
TAG=${TAG:-latest}
build() { # FILE IMAGE CONTEXT
    case $ENGINE in
        # shellcheck disable=SC2086
        buildah) buildah ${BUILDAH_FLAGS:-} bud ${BUD_FLAGS:-} --build-arg "BASE=$BASE" --build-arg "BUILD=caudata/build:$TAG" -f "$1" -t "$2:$TAG" "$3" ;;
        *) "$ENGINE" build --build-arg "BASE=$BASE" --build-arg "BUILD=caudata/build:$TAG" -f "$1" -t "$2:$TAG" "$3" ;;
    esac
}
if [ "${1:-}" = --prebuilt ]; then
    shift
    out=$(mktemp -d)
    trap 'rm -rf "$out"' EXIT
    docker/images/collect.sh "${TARGET_DIR:-target/release}" "$out"
    build docker/images/prebuilt.Dockerfile caudata/build "$out"
else
    build docker/images/build.Dockerfile caudata/build .
fi
[ $# -gt 0 ] || set -- actor policy-server learner
for name in "$@"; do
    build "docker/images/$name.Dockerfile" "caudata/$name" .
done
