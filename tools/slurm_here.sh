#!/usr/bin/env bash
# A Slurm of one node without installation, for tests: `tools/slurm_here.sh unpack FOLDER` downloads the packages of
# Debian and unpacks them, `. tools/slurm_here.sh start FOLDER` starts the daemons and sets the environment, `stop` ends
# them. Needs root, because auth/none trusts the user of a request.
action=$1 folder=$2
case $action in
unpack)
    mkdir -p "$folder/packages" && (cd "$folder/packages" && apt-get download slurmctld slurmd slurm-client \
        slurm-wlm-basic-plugins libhwloc15 liblua5.1-0 libmunge2)
    for package in "$folder"/packages/*.deb; do dpkg -x "$package" "$folder"; done
    ;;
start)
    lib=$(dirname "$(find "$folder/usr/lib" -name libhwloc.so.15)")
    state=$folder/state
    rm -rf "$state" && mkdir -p "$state/spool" "$state/saved"
    host=$(hostname -s)
    cat > "$state/slurm.conf" <<CONF
ClusterName=here
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=${SLURM_TEST_PORT:-16817}
SlurmdPort=$((${SLURM_TEST_PORT:-16817} + 1))
AuthType=auth/none
CredType=cred/none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SchedulerType=sched/builtin
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SlurmdParameters=config_overrides
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
PluginDir=$lib/slurm-wlm
StateSaveLocation=$state/saved
SlurmdSpoolDir=$state/spool
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/slurmd.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdLogFile=$state/slurmd.log
ReturnToService=2
NodeName=$host NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
    export SLURM_CONF=$state/slurm.conf LD_LIBRARY_PATH=$lib:$lib/slurm-wlm PATH=$folder/usr/bin:$PATH
    "$folder/usr/sbin/slurmctld-wlm"
    "$folder/usr/sbin/slurmd-wlm" -d "$folder/usr/sbin/slurmstepd-wlm"
    ;;
stop)
    for daemon in slurmd slurmctld; do kill "$(cat "$folder/state/$daemon.pid")"; done
    ;;
esac
