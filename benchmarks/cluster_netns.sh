#!/usr/bin/env bash
# cluster_netns.sh - a multi-host Ray cluster on one Linux machine, no containers needed.
#
# Every "host" is a set of Linux namespaces (net + pid + mount + uts + ipc): own IP address, own process
# table, own /tmp, own /dev/shm, own hostname.  The hosts hang on a bridge that lives in a namespace of its
# own, with no up-link: nothing they send can leave the machine.
#
#   cluster_netns.sh up [N]            a head and N workers (default 2), Ray started on each
#   cluster_netns.sh hosts [N]         the same without Ray (plain hosts)
#   cluster_netns.sh down              stop everything that `up` made
#   cluster_netns.sh exec HOST CMD...  run CMD on head | w1 | w2 ... (RAY_ADDRESS is set)
#   cluster_netns.sh status            hosts, addresses, ray nodes
#   cluster_netns.sh ray-start HOST    (re)start Ray on a host;   ray-stop HOST: graceful
#   cluster_netns.sh kill-raylet HOST  SIGKILL the raylet only
#   cluster_netns.sh kill HOST         SIGKILL pid 1 of the host: all its processes die, its kernel still answers
#   cluster_netns.sh poweroff HOST     cut, then kill: peers hear nothing at all (no FIN, no RST)
#   cluster_netns.sh boot HOST         switch a killed host on again, with Ray
#   cluster_netns.sh cut|heal HOST     unplug / plug the cable at the switch (silent loss, no RST)
#   cluster_netns.sh delay HOST MS     add latency (tc netem, where the kernel has it); 0 removes it
#
# Env: RC_PREFIX (rc) RC_NET (10.88.0) RC_DIR (~/.cluster_netns; not under /tmp, which each host has for itself) RC_PY (python with ray)
#      RC_CPUS (2) RC_STORE (100 MiB, bytes) RC_RES_HEAD / RC_RES_WORKER (JSON) RC_SYSCONF (head: JSON)
#      RC_DASHBOARD (1) RC_AUTH (token|disabled); every RAY_* variable is handed on to the hosts.
# Needs: root, iproute2, util-linux (unshare, nsenter).
set -euo pipefail

P=${RC_PREFIX:-rc}; NET=${RC_NET:-10.88.0}; DIR=${RC_DIR:-$HOME/.cluster_netns}; PY=${RC_PY:-$(python3 -c 'import sys; print(sys.executable)')}
CPUS=${RC_CPUS:-2}; STORE=${RC_STORE:-104857600}; AUTH=${RC_AUTH:-token}
RES_HEAD=${RC_RES_HEAD:-'{"head":1,"learner":1,"replay":1}'}; RES_WORKER=${RC_RES_WORKER:-'{"actor":4}'}
RAY="$(dirname "$PY")/ray"; PORT=6379
SW=$P-sw                                                   # the switch's namespace

addr() { case $1 in head) echo "$NET.1";; w*) echo "$NET.$((${1#w} + 1))";; *) echo "no such host: $1" >&2; return 1;; esac; }
pid1() { cat "$DIR/$1/pid1"; }
alive() { [ -s "$DIR/$1/pid1" ] && kill -0 "$(pid1 "$1")" 2>/dev/null; }
hosts_known() { (cd "$DIR" 2>/dev/null && ls -d head w[0-9]* 2>/dev/null) || true; }

switch_up() {
  ip netns add "$SW"; ip -n "$SW" link set lo up
  ip -n "$SW" link add br0 type bridge; ip -n "$SW" link set br0 up
}
net_up() {                                                 # cable and address of one host
  local h=$1 ns=$P-$1
  ip netns add "$ns"; ip -n "$ns" link set lo up
  ip -n "$SW" link add "v-$h" type veth peer name eth0 netns "$ns"
  ip -n "$SW" link set "v-$h" master br0 up
  ip -n "$ns" addr add "$(addr "$h")/24" dev eth0; ip -n "$ns" link set eth0 up
  ip -n "$ns" route add default dev eth0                   # so that "what is my address" works; leads nowhere
}
boot() {                                                   # pid 1 of the host: a bash that only reaps
  local h=$1 ns=$P-$1 d=$DIR/$1
  mkdir -p "$d/tmp" "$d/home"; chmod 1777 "$d/tmp"; rm -f "$d/pid1"
  # setsid: survives the shell that called us.  The outer unshare waits; its only child is pid 1.
  D=$d H=$h P=$P setsid ip netns exec "$ns" unshare --pid --mount --uts --ipc --fork --kill-child bash -c '
      mount --make-rprivate /; mount -t proc proc /proc; hostname "$P-$H"
      mount -t tmpfs -o mode=1777,size=2g tmpfs /dev/shm; mount --bind "$D/tmp" /tmp
      trap "exit 0" TERM; touch "$D/booted"; while :; do sleep 3600 & wait $!; done' \
      </dev/null >"$d/boot.log" 2>&1 &
  local up=$! i
  for i in $(seq 100); do
    [ -e "$d/booted" ] && break; sleep 0.05
  done
  rm -f "$d/booted"
  # pid 1 of the host as seen from outside: the child of unshare
  local u c; u=$up
  for i in 1 2 3 4; do c=$(cat "/proc/$u/task/$u/children" 2>/dev/null | tr -d ' '); [ -n "$c" ] || break
    [ "$(cat /proc/$c/comm)" = bash ] && break; u=$c; done
  echo "${c:?boot of $h failed, see $d/boot.log}" >"$d/pid1"
}
enter() {                                                  # run on a host
  local h=$1; shift
  alive "$h" || { echo "host $h is down" >&2; return 1; }
  local env=(RAY_ADDRESS="$(addr head):$PORT" HOME="$DIR/$h/home" PATH="$(dirname "$PY"):$PATH" TMPDIR=/tmp
             RAY_USAGE_STATS_ENABLED=0 RAY_AUTH_MODE="$AUTH" PYTHONUNBUFFERED=1 RC_HOST="$h" RC_ADDR="$(addr "$h")"
             RAY_API_SERVER_ADDRESS="http://$(addr head):8265")
  [ "$AUTH" = token ] && env+=(RAY_AUTH_TOKEN_PATH="$DIR/token")
  nsenter -t "$(pid1 "$h")" --net --pid --mount --uts --ipc --wd="$PWD" -- env "${env[@]}" "$@"
}
ray_start() {
  local h=$1; local a; a=$(addr "$h")
  local o=(--node-ip-address "$a" --num-cpus "$CPUS" --object-store-memory "$STORE" --disable-usage-stats
           --labels "host=$h" --log-style record)
  if [ "$h" = head ]; then
    o+=(--head --port $PORT --resources "$RES_HEAD" --dashboard-host "$a")
    [ "${RC_DASHBOARD:-1}" = 1 ] || o+=(--include-dashboard=false)
    [ -n "${RC_SYSCONF:-}" ] && o+=(--system-config "$RC_SYSCONF")
  else o+=(--address "$(addr head):$PORT" --resources "$RES_WORKER"); fi
  # Daemons must not hold our stdout open: give them a file.
  enter "$h" env -u RAY_ADDRESS "$RAY" start "${o[@]}" </dev/null >"$DIR/$h/ray_start.log" 2>&1 ||
    { echo "ray start on $h failed:" >&2; tail -20 "$DIR/$h/ray_start.log" >&2; return 1; }
}
case ${1:-} in
up|hosts)
  n=${2:-2}; [ -z "$(hosts_known)" ] || { echo "already up ($DIR); say down first" >&2; exit 1; }
  mkdir -p "$DIR"; (umask 077; [ -s "$DIR/token" ] || od -An -N32 -tx1 /dev/urandom | tr -d ' \n' >"$DIR/token")
  switch_up
  for h in head $(seq -f 'w%g' "$n"); do net_up "$h"; boot "$h"; done
  [ "$1" = hosts ] && exit 0
  ray_start head; pids=()
  for h in $(seq -f 'w%g' "$n"); do ray_start "$h" & pids+=($!); done
  for p in ${pids[@]+"${pids[@]}"}; do wait "$p"; done
  echo "head $(addr head):$PORT; workers: $(for h in $(seq -f 'w%g' "$n"); do printf '%s=%s ' "$h" "$(addr "$h")"; done)" ;;
down)
  for h in $(hosts_known); do alive "$h" && kill -KILL "$(pid1 "$h")" || true; done
  for h in $(hosts_known); do for i in $(seq 100); do alive "$h" || break; sleep 0.05; done
    ip netns del "$P-$h" 2>/dev/null || true; rm -rf "${DIR:?}/$h"; done
  ip netns del "$SW" 2>/dev/null || true; rm -f "$DIR/token"; rmdir "$DIR" 2>/dev/null || true ;;
exec) h=$2; shift 2; enter "$h" "$@" ;;
status) for h in $(hosts_known); do printf '%-5s %-12s %s\n' "$h" "$(addr "$h")" "$(alive "$h" && echo "up, pid1 $(pid1 "$h")" || echo down)"; done
  enter head "$PY" -c 'import ray; ray.init(logging_level="error", log_to_driver=False)
for n in ray.nodes(): print(n["NodeManagerAddress"], "ALIVE" if n["Alive"] else "DEAD: "+str(n.get("DeathReasonMessage")), {k:v for k,v in n["Resources"].items() if not k.startswith(("node:","memory","object"))})' ;;
ray-start) ray_start "$2" ;;
ray-stop) enter "$2" "$RAY" stop --grace-period 5 >/dev/null ;;
kill-raylet) enter "$2" bash -c 'for p in /proc/[0-9]*; do [ "$(cat $p/comm 2>/dev/null)" = raylet ] && kill -9 ${p#/proc/}; done; true' ;;
kill) kill -KILL "$(pid1 "$2")" ;;
poweroff) ip -n "$SW" link set "v-$2" nomaster; kill -KILL "$(pid1 "$2")" ;;
boot) alive "$2" && { echo "$2 is up" >&2; exit 1; }; rm -rf "$DIR/$2/tmp"; ip -n "$SW" link set "v-$2" master br0; boot "$2"; ray_start "$2" ;;
cut) ip -n "$SW" link set "v-$2" nomaster ;;               # the cable stays "up": packets just vanish
heal) ip -n "$SW" link set "v-$2" master br0 ;;
delay) if [ "$3" = 0 ]; then ip netns exec "$SW" tc qdisc del dev "v-$2" root; else ip netns exec "$SW" tc qdisc replace dev "v-$2" root netem delay "${3}ms"; fi ;;
*) sed -n '2,/^set /p' "$0" | sed '$d; s/^# \{0,1\}//'; exit 2 ;;
esac
