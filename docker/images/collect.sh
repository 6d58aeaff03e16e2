#!/bin/sh
# Lays out what the images take:  collect.sh TARGET_DIR OUT
#   OUT/bin       executables, without debug information
#   OUT/lib       libonnxruntime.so
#   OUT/libtorch  the libraries of libtorch that the learner loads
#   OUT/robots    robot files
#   OUT/share     factory.onnx, a robot's last resort
# LIBTORCH and ORT_DYLIB_PATH say where the libraries are; .cargo/env.sh has them after `make setup`.
set -eu
target=$1
out=$2
here=$(cd "$(dirname "$0")/../.." && pwd)
if [ -z "${ORT_DYLIB_PATH:-}" ] && [ -f "$here/.cargo/env.sh" ]; then
    # shellcheck disable=SC1091
    . "$here/.cargo/env.sh"
fi
: "${ORT_DYLIB_PATH:?run make setup first}"
mkdir -p "$out/bin" "$out/lib" "$out/libtorch"
for name in caudata caudata-actor caudata-learner caudata-policy-server caudata-robot; do
    strip -o "$out/bin/$name" "$target/$name"
done
install -m 0644 "$ORT_DYLIB_PATH" "$out/lib/libonnxruntime.so"
if [ -n "${LIBTORCH:-}" ]; then
    for library in "$LIBTORCH"/lib/*.so*; do
        # libtorch.so is a linker script, read at build time only.
        [ "$(basename "$library")" = libtorch.so ] && continue
        cp -L "$library" "$out/libtorch/"
    done
fi
cp -r "$here/robots" "$out/robots"
# What a robot falls back on (docker/systemd/caudata-robot-agent.service).
install -D -m 0644 "$here/policies/flat.onnx" "$out/share/factory.onnx"
