#!/bin/sh
# A whole Slurm on this host, as root and without systemd, for the test:  one_host_slurm.sh start|stop DIR [HOSTS]
# With HOSTS as many nodes, n1 and so on, each with a name, an address and a network of its own (ip netns) on a bridge.
# Its own key, sockets and ports, so that it disturbs no Slurm that is there. Clients use it with SLURM_CONF=DIR/slurm.conf.
set -eu
what=$1
dir=$2
hosts=${3:-0}
# Names of this Slurm's own: of its bridge (15 letters at most) and of its networks.
tag=cau$(printf %s "$dir" | cksum | cut -c 1-6)
net=10.$((64 + $(printf %s "$dir" | cksum | cut -d ' ' -f 1) % 128)).77
# A node of its own network, the other end of a cable in the bridge.
host() { # NUMBER
    name=$tag-$1
    ip netns add "$name"
    ip link add "$tag.$1" type veth peer name eth0 netns "$name"
    ip link set "$tag.$1" master "$tag" up
    ip -n "$name" address add "$net.1$1/24" dev eth0
    ip -n "$name" link set eth0 up
    ip -n "$name" link set lo up
    echo "$net.1$1 n$1.lab n$1" >> "$dir/hosts"
    echo "NodeName=n$1 NodeAddr=$net.1$1 CPUs=1 RealMemory=2000 State=UNKNOWN" >> "$dir/slurm.conf"
}
case $what in
    start)
        for program in munged slurmctld slurmd; do
            command -v "$program" > /dev/null || { echo "$program is not installed (Debian: slurm-wlm munge)" >&2; exit 69; }
        done
        [ "$(id -u)" = 0 ] || { echo "must be root" >&2; exit 69; }
        mkdir -p "$dir/state" "$dir/spool" "$dir/munge"
        # munged wants a path that nobody else can write to.
        chmod 0755 "$dir" "$dir/munge"
        dd if=/dev/urandom of="$dir/munge/key" bs=128 count=1 2> /dev/null
        chmod 0600 "$dir/munge/key"
        munged --force --key-file="$dir/munge/key" --socket="$dir/munge/socket" --pid-file="$dir/munge/pid" \
            --log-file="$dir/munge/log" --seed-file="$dir/munge/seed"
        port=$((20000 + $$ % 20000))
        address=127.0.0.1
        if [ "$hosts" -gt 0 ]; then
            address=$net.1
            ip link add "$tag" type bridge
            ip address add "$address/24" dev "$tag"
            ip link set "$tag" up
        fi
        cat > "$dir/slurm.conf" <<CONF
ClusterName=caudata
SlurmctldHost=$(hostname)($address)
SlurmctldPort=$port
SlurmdPort=$((port + 1))
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$dir/munge/socket
CredType=cred/munge
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
SchedulerParameters=batch_sched_delay=1,sched_interval=5
MinJobAge=60
KillWait=20
ReturnToService=2
JobRequeue=1
MailProg=/bin/true
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool/%n
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd-%n.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd-%n.log
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
        SLURM_CONF=$dir/slurm.conf
        export SLURM_CONF
        echo '127.0.0.1 localhost' > "$dir/hosts"
        for number in $(seq "$hosts"); do
            host "$number"
        done
        [ "$hosts" -gt 0 ] || echo "NodeName=$(hostname) NodeAddr=127.0.0.1 CPUs=16 CoresPerSocket=16 RealMemory=2000 State=UNKNOWN" >> "$dir/slurm.conf"
        slurmctld -f "$SLURM_CONF"
        for number in $(seq "$hosts"); do
            # Not `ip netns exec`, which hides cgroups.
            nsenter --net="/run/netns/$tag-$number" unshare --mount --uts sh -c \
                "mount --bind '$dir/hosts' /etc/hosts && hostname n$number && exec slurmd -f '$SLURM_CONF'"
        done
        [ "$hosts" -gt 0 ] || slurmd -f "$SLURM_CONF"
        # Up when the nodes take jobs.
        tries=0
        until [ "$(sinfo --noheader --Node --format=%t 2> /dev/null | grep -c idle)" -ge "$((hosts > 1 ? hosts : 1))" ]; do
            tries=$((tries + 1))
            [ "$tries" -lt 60 ] || { echo "not every node comes up; see $dir/slurmctld.log" >&2; exit 75; }
            sleep 1
        done
        ;;
    stop)
        export SLURM_CONF="$dir/slurm.conf"
        scancel --user=root 2> /dev/null || true
        for file in "$dir"/slurmd-*.pid "$dir/slurmctld.pid" "$dir/munge/pid"; do
            [ -f "$file" ] && kill "$(cat "$file")" 2> /dev/null || true
        done
        ip netns list 2> /dev/null | grep -o "^$tag-[0-9]*" | while read -r name; do
            ip netns del "$name"
        done
        ip link del "$tag" 2> /dev/null || true
        ;;
    *) echo "start or stop" >&2; exit 64 ;;
esac
