#!/bin/sh
# A whole Slurm on this host, as root and without systemd, for the test:  one_host_slurm.sh start|stop DIR
# Its own key, sockets and ports, so that it disturbs no Slurm that is there. Clients use it with SLURM_CONF=DIR/slurm.conf.
set -eu
what=$1
dir=$2
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
        cat > "$dir/slurm.conf" <<CONF
ClusterName=caudata
SlurmctldHost=$(hostname)(127.0.0.1)
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
SlurmdSpoolDir=$dir/spool
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
NodeName=$(hostname) NodeAddr=127.0.0.1 CPUs=16 CoresPerSocket=16 RealMemory=2000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
        SLURM_CONF=$dir/slurm.conf
        export SLURM_CONF
        slurmctld -f "$SLURM_CONF"
        slurmd -f "$SLURM_CONF"
        # Up when the node takes jobs.
        tries=0
        until sinfo --noheader --format=%t 2> /dev/null | grep -q idle; do
            tries=$((tries + 1))
            [ "$tries" -lt 60 ] || { echo "the node does not come up; see $dir/slurmctld.log" >&2; exit 75; }
            sleep 1
        done
        ;;
    stop)
        export SLURM_CONF="$dir/slurm.conf"
        scancel --user=root 2> /dev/null || true
        for pid in slurmd slurmctld munge/pid; do
            file=$dir/$pid
            [ -f "$file" ] || file=$dir/$pid.pid
            [ -f "$file" ] && kill "$(cat "$file")" 2> /dev/null || true
        done
        ;;
    *) echo "start or stop" >&2; exit 64 ;;
esac
