#!/bin/sh
# Copies a program and the shared libraries that it loads into a root file system:  root.sh ROOT PROGRAM [LIBRARY ...]
# What is not there is an error: an image that lacks a library would fail only on the cluster.
set -eu
root=$1
shift
mkdir -p "$root/usr/local/bin" "$root/tmp" "$root/etc"
chmod 1777 "$root/tmp"
cp "$1" "$root/usr/local/bin/"
missing=$(ldd "$@" | grep 'not found' || true)
if [ -n "$missing" ]; then
    echo "root.sh: $missing" >&2
    exit 1
fi
ldd "$@" | sed -n 's/.*=> \(\/[^ ]*\) .*/\1/p; s/^[[:space:]]*\(\/lib[^ ]*ld-[^ ]*\) .*/\1/p' | sort -u | while read -r library; do
    case $library in
        /opt/caudata/*) continue ;;
    esac
    mkdir -p "$root$(dirname "$library")"
    cp -L "$library" "$root$library"
done
# glibc asks these for names.
for library in libnss_dns.so.2 libnss_files.so.2 libresolv.so.2; do
    found=$(find /lib /usr/lib -name "$library" 2>/dev/null | head -n 1)
    [ -n "$found" ] && mkdir -p "$root$(dirname "$found")" && cp -L "$found" "$root$found"
done
echo 'hosts: files dns' > "$root/etc/nsswitch.conf"
echo 'caudata:x:65532:65532::/:/nologin' > "$root/etc/passwd"
echo 'caudata:x:65532:' > "$root/etc/group"
