#!/usr/bin/env bash
# Ray by hand on hosts that are entered by ssh: launch/hosts.sh up | down | COMMAND...
#
#   launch/hosts.sh up
#   launch/hosts.sh apex-bat train --cluster auto --run /shared/runs/one --set actors=auto
#   launch/hosts.sh down
#
# COMMAND runs on the head, in FOLDER. Every host needs this project in FOLDER with its .venv. Lines to edit are marked
# EDIT. DRY=1 prints what would be run.
set -euo pipefail

HEAD=${HEAD:-bat1}                       # EDIT: the host where training is started
WORKERS=${WORKERS:-bat2 bat3}            # EDIT: the others
FOLDER=${FOLDER:-apex_bat}               # EDIT: this project there, relative to the home folder
PORT=${PORT:-6379}
TOKEN=.ray/auth_token                    # relative to the home folder; `up` makes one on the head where none is

on() { # HOST COMMAND: standard input goes along
    if [ -n "${DRY:-}" ]; then echo "ssh $1 -- $2"; else ssh -o BatchMode=yes "$1" -- "$2"; fi
}
environment="set -e; cd $FOLDER; export PATH=\$PWD/.venv/bin:\$PATH RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH=\$HOME/$TOKEN"
environment+=" RAY_worker_niceness=0 RAY_USAGE_STATS_ENABLED=0"

case ${1:-} in
up)
    make="umask 077; mkdir -p ~/.ray; [ -s ~/$TOKEN ] || od -An -N32 -tx1 /dev/urandom | tr -d ' \n' > ~/$TOKEN"
    token=$(on "$HEAD" "$make; cat ~/$TOKEN" </dev/null)
    [ -z "${DRY:-}" ] || echo "$token"
    for host in $WORKERS; do # by standard input: what stands in a command line, everybody on the host can read
        on "$host" "umask 077; mkdir -p ~/.ray; cat > ~/$TOKEN" < <(printf %s "$token")
    done
    on "$HEAD" "$environment; ray start --head --port=$PORT --dashboard-host=127.0.0.1" </dev/null
    for host in $WORKERS; do
        on "$host" "$environment; ray start --address=\$(getent ahostsv4 $HEAD | awk '{print \$1; exit}'):$PORT" </dev/null
    done
    ;;
down) for host in $WORKERS $HEAD; do on "$host" "$environment; ray stop" </dev/null; done ;;
"") sed -n '2,/^set /p' "$0" | sed '$d; s/^# \{0,1\}//'; exit 2 ;;
*) on "$HEAD" "$environment; $*" ;;
esac
