#!/usr/bin/env python3
"""Builds an SD card for a Raspberry Pi Zero 2 W (or 3) that runs the robot's program: Debian for arm64 with its real-time
kernel, the program with ONNX Runtime, robots, a policy to fall back to, and the units of docker/systemd. As root on
Debian and its kin on x86-64, after `make setup-arm`; what builds the image is installed where it is missing.

    setup/pi_image.py --ssh-key id_ed25519.pub [--wifi wpa_supplicant.conf] [--hostname NAME]
    setup/pi_image.py --boot        start the image in QEMU as a Raspberry Pi 3 with the Zero's device tree, and ask it

The board's own boot loader does not run in QEMU; all after it does.
"""

import argparse
import glob
import os
import shutil
import subprocess
import sys
import threading

import arm
from common import PlatformError, SetupError, say
from stage import CHECKOUT

HERE = os.path.join(CHECKOUT, "target", "arm")
ROOT = os.path.join(HERE, "pi-root")
IMAGE = os.path.join(HERE, "caudata-pi.img")
BOARD = "bcm2837-rpi-zero-2-w.dtb"
NEEDS = {
    "mmdebstrap": "mmdebstrap", "arch-test": "arch-test", "mkfs.vfat": "dosfstools", "mcopy": "mtools", "sfdisk": "fdisk",
    "mkfs.ext4": "e2fsprogs", "qemu-system-aarch64": "qemu-system-arm",
}
SYSTEM = (
    "linux-image-rt-arm64 raspi-firmware firmware-brcm80211 initramfs-tools systemd-sysv systemd-resolved systemd-timesyncd udev dbus kmod "
    "iproute2 wpasupplicant openssh-server ca-certificates rt-tests i2c-tools"
).split()
BOOT_MIB = 256
# Room for policies, state and logs beside what is laid out.
FREE_MIB = 768
# The last of the four cores is the control loop's alone, at its full clock.
KERNEL = "isolcpus=3 nohz_full=3 rcu_nocbs=3 irqaffinity=0-2 cpufreq.default_governor=performance"
FILES = {
    "etc/fstab": "LABEL=caudata / ext4 noatime,errors=remount-ro 0 1\nLABEL=BOOT /boot/firmware vfat umask=0077 0 2\n",
    "etc/default/raspi-extra-cmdline": KERNEL + "\n",
    "etc/modules-load.d/caudata.conf": "i2c-dev\n",
    "etc/systemd/network/20-all.network": "[Match]\nName=wlan* en* end*\n[Network]\nDHCP=yes\n",
    "etc/systemd/system/caudata-robot-rt.service.d/core.conf": "[Service]\nCPUAffinity=3\n",
    "etc/ssh/sshd_config.d/keys.conf": "PasswordAuthentication no\n",
    # Each card makes keys and an identity of its own when it first starts.
    "etc/systemd/system/ssh.service.d/keys.conf": "[Service]\nExecStartPre=\nExecStartPre=/usr/bin/ssh-keygen -A\nExecStartPre=/usr/sbin/sshd -t\n",
    "etc/machine-id": "uninitialized\n",
}
ASK = (
    "uname -v; test $(cat /sys/kernel/realtime) = 1 && /opt/caudata/bin/caudata-robot --version"
    " && /opt/caudata/bin/caudata-robot doctor --robot /etc/caudata/polymander.robot.toml"
    " --wiring /etc/caudata/robot.wiring.toml; echo doctor ended with $?;"
    " systemd-analyze verify caudata-robot-agent.service caudata-robot-rt.service && echo units are right;"
    " cat /sys/devices/system/cpu/isolated; systemctl start ssh; systemctl is-active ssh systemd-resolved; ls /etc/ssh/*.pub; cyclictest -q -m -p 90 -i 1000 -l 2000 -a 3"
)
ANSWERS = ("PREEMPT_RT", "caudata-robot 0", "doctor ended with 69", "units are right", "ssh_host_ed25519_key.pub", "P:90", "Power down")
BOOT_WITHIN_S = 1200.0


def main() -> int:
    parser = argparse.ArgumentParser(prog="setup/pi_image.py", description=__doc__.split("\n\n")[0])
    parser.add_argument("--ssh-key", metavar="FILE", help="public key that may log in as root; without it nobody may")
    parser.add_argument("--wifi", metavar="FILE", help="wpa_supplicant.conf of the network; without it only a cable's")
    parser.add_argument("--hostname", default="salamander")
    parser.add_argument("--boot", action="store_true", help="start the image that was built, and ask it")
    options = parser.parse_args()
    try:
        if options.boot:
            boot()
            return 0
        tools()
        system()
        lay_out(options)
        write_image()
        say("image: %s, %d MiB" % (os.path.relpath(IMAGE), os.path.getsize(IMAGE) >> 20))
    except SetupError as error:
        say("pi image: %s (%s)" % ("skipped" if isinstance(error, PlatformError) else "error", error))
        return error.exit_code
    return 0


def tools() -> None:
    missing = sorted(package for program, package in NEEDS.items() if not shutil.which(program))
    if os.geteuid() != 0:
        raise PlatformError("a root file system is laid out by root only")
    if missing:
        say("pi image: installing " + " ".join(missing))
        arm.run("apt-get", "update")
        arm.run("apt-get", "install", "-y", "--no-install-recommends", *missing)


def system() -> None:
    """Debian, which is kept for the next image."""
    if os.path.exists(ROOT):
        return
    arm.emulation()
    building = ROOT + ".tmp"
    # An image that was broken off may have left file systems mounted there: they are of the machine.
    arm.run("rm", "-rf", "--one-file-system", building)
    say("pi image: laying out Debian %s for arm64, some minutes" % arm.DEBIAN_SUITE)
    arm.run(
        "unshare", "--mount", "mmdebstrap", "--mode=root", "--architectures=arm64", "--variant=minbase", "--skip=check/qemu",
        "--components=main non-free-firmware", "--keyring=/usr/share/keyrings", "--aptopt=Acquire::Languages none",
        "--include=" + ",".join(SYSTEM), arm.DEBIAN_SUITE, building, arm.debian_mirror(),
    )
    arm.run("chroot", building, "useradd", "--system", "--no-create-home", "caudata")
    arm.run("chroot", building, "systemctl", "enable", "systemd-networkd", "systemd-resolved", "wpa_supplicant@wlan0", "ssh")
    os.rename(building, ROOT)


def lay_out(options: argparse.Namespace) -> None:
    program = os.path.join(HERE, arm.TARGET, "release", "caudata-robot")
    if not os.path.exists(program):
        raise PlatformError("%s is missing: `make build-arm` builds it" % os.path.relpath(program))
    for path, text in FILES.items():
        put(path, text)
    put("etc/hostname", options.hostname + "\n")
    put("etc/hosts", "127.0.0.1 localhost\n127.0.1.1 %s\n" % options.hostname)
    for path, source in (("root/.ssh/authorized_keys", options.ssh_key), ("etc/wpa_supplicant/wpa_supplicant-wlan0.conf", options.wifi)):
        # of an image before this one
        if os.path.exists(os.path.join(ROOT, path)):
            os.remove(os.path.join(ROOT, path))
        if source:
            put(path, read(source), 0o600)
    for key in glob.glob(os.path.join(ROOT, "etc/ssh/ssh_host_*")):
        os.remove(key)
    # this machine's servers of names are not the robot's
    names = os.path.join(ROOT, "etc/resolv.conf")
    if os.path.lexists(names):
        os.remove(names)
    os.symlink("/run/systemd/resolve/stub-resolv.conf", names)
    copy(program, "opt/caudata/bin/caudata-robot")
    arm.run("aarch64-linux-gnu-strip", os.path.join(ROOT, "opt/caudata/bin/caudata-robot"))
    library = arm.parts.provision(arm.pins.ONNXRUNTIME["aarch64"])
    copy(os.path.join(library, "lib/libonnxruntime.so"), "opt/caudata/lib/libonnxruntime.so")
    copy(os.path.join(CHECKOUT, "policies/flat.onnx"), "opt/caudata/share/factory.onnx")
    for name in ("polymander.robot.toml", "polymander.xml"):
        copy(os.path.join(CHECKOUT, "robots", name), "etc/caudata/" + name)
    copy(os.path.join(CHECKOUT, "robots/polymander.wiring.toml"), "etc/caudata/robot.wiring.toml")
    # Not started by themselves: a robot stands up when they are, and its wiring is not known yet.
    for unit in glob.glob(os.path.join(CHECKOUT, "docker/systemd/caudata-robot-*.service")):
        copy(unit, "etc/systemd/system/" + os.path.basename(unit))
    # Debian's hook copies kernel and device trees, and writes config.txt and cmdline.txt: for the package manager, and
    # where it can see that it is in a chroot.
    hook = 'mount -t proc proc "$0/proc" && DEB_MAINT_PARAMS=configure chroot "$0" /etc/kernel/postinst.d/z50-raspi-firmware "$1"'
    arm.run("unshare", "-m", "sh", "-c", hook, ROOT, kernel())


def kernel() -> str:
    return os.path.basename(glob.glob(os.path.join(ROOT, "boot/vmlinuz-*"))[-1])[len("vmlinuz-"):]


def read(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except (OSError, UnicodeDecodeError) as error:
        raise SetupError("cannot read %s: %s" % (path, error))


def put(path: str, text: str, mode: int = 0o644) -> None:
    path = os.path.join(ROOT, path)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    arm.write(path, text)
    os.chmod(path, mode)


def copy(source: str, into: str) -> None:
    into = os.path.join(ROOT, into)
    os.makedirs(os.path.dirname(into), exist_ok=True)
    shutil.copy(source, into)


def write_image() -> None:
    """A partition for the board's boot loader and one for Debian."""
    parts = [os.path.join(HERE, "pi-%s.part" % name) for name in ("boot", "root")]
    firmware = os.path.join(ROOT, "boot/firmware")
    used = int(subprocess.run(["du", "-sxm", ROOT], stdout=subprocess.PIPE, check=True).stdout.split()[0])
    sizes = (BOOT_MIB, used + used // 10 + FREE_MIB)
    for path, mib in zip(parts, sizes):
        with open(path, "wb") as file:
            file.truncate(mib << 20)
    arm.run("mkfs.vfat", "-n", "BOOT", parts[0])
    arm.run("mcopy", "-s", "-i", parts[0], *glob.glob(os.path.join(firmware, "*")), "::")
    arm.run("mkfs.ext4", "-q", "-L", "caudata", "-d", ROOT, parts[1])
    with open(IMAGE + ".tmp", "wb") as file:
        file.truncate((1 + sum(sizes) + 1) << 20)
    table = "label: dos\nstart=2048, size=%dMiB, type=c, bootable\nstart=%dMiB, size=%dMiB, type=83\n"
    arm.run("sfdisk", "-q", IMAGE + ".tmp", input=(table % (sizes[0], 1 + sizes[0], sizes[1])).encode())
    for path, at in zip(parts, (1, 1 + sizes[0])):
        arm.run("dd", "if=" + path, "of=" + IMAGE + ".tmp", "bs=1M", "seek=%d" % at, "conv=notrunc,sparse")
        os.remove(path)
    os.replace(IMAGE + ".tmp", IMAGE)


def boot() -> None:
    """Prints what the image says to `ASK` in place of a login."""
    if not os.path.exists(IMAGE):
        raise PlatformError("%s is missing: `make pi-image` builds it" % os.path.relpath(IMAGE))
    card = os.path.join(HERE, "pi-card.img")
    shutil.copy(IMAGE, card)
    # QEMU takes cards whose size is a power of two only.
    size = 1 << (os.path.getsize(card) - 1).bit_length()
    os.truncate(card, size)
    firmware = os.path.join(ROOT, "boot/firmware")
    line = 'root=LABEL=caudata rw console=ttyS1,115200 quiet %s systemd.run="/bin/sh -c \'%s\'"'
    command = [
        "qemu-system-aarch64", "-M", "raspi3b", "-display", "none", "-serial", "null", "-serial", "stdio", "-no-reboot",
        "-drive", "if=sd,format=raw,file=" + card,
        "-kernel", os.path.join(ROOT, "boot/vmlinuz-" + kernel()), "-initrd", os.path.join(ROOT, "boot/initrd.img-" + kernel()),
        "-dtb", os.path.join(firmware, BOARD), "-append", line % (KERNEL, ASK),
    ]
    board = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
    # an image that hangs is ended
    timer = threading.Timer(BOOT_WITHIN_S, board.kill)
    timer.start()
    told = ""
    for raw in board.stdout:
        text = raw.decode("utf-8", "replace")
        told += text
        print(text, end="", flush=True)
    code = board.wait()
    timer.cancel()
    os.remove(card)
    missing = [words for words in ANSWERS if words not in told]
    if code != 0 or missing:
        raise SetupError("the image did not come up: QEMU ended with %d, and it did not say: %s" % (code, ", ".join(missing)))
    say("image: comes up")


if __name__ == "__main__":
    sys.exit(main())
