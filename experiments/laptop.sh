#!/usr/bin/env bash
# README's commands on a small laptop: 8 GB of memory for everything, a home that can't be written,
# no network, the C locale.
#
# Command: sudo bash experiments/laptop.sh (Linux with control groups of version 1; after `make demo`
#          has set up the environment, which needs a network)
# Cost:    half an hour on two cores.
# Result:  experiments/results/laptop.md: exit status, minutes, processes killed for memory.
set -euo pipefail
cd "$(dirname "$0")/.."
group=/sys/fs/cgroup/memory/physxnet_laptop_$$
work=$(mktemp -d)
mkdir "$group" "$work/home"
echo $((8 * 1024 * 1024 * 1024)) >"$group/memory.limit_in_bytes"
killed() { awk '/^oom_kill / { print $2 }' "$group/memory.oom_control"; }
printf '| command | exit | minutes | killed for memory |\n|---|---|---|---|\n' >"$work/table"
[ $# -gt 0 ] || set -- "make demo" "make test"
for words in "$@"; do
    begun=$(date +%s)
    before=$(killed)
    code=0
    (
        echo "$BASHPID" >"$group/cgroup.procs" || exit 99
        unshare --net --mount bash -c "
            set -e
            ip link set lo up
            mount --bind '$work/home' '$work/home'
            mount -o remount,ro,bind '$work/home'
            export HOME='$work/home' LC_ALL=C LANG=C
            unset XDG_CACHE_HOME
            if touch '$work/home/try' 2>/dev/null; then exit 98; fi
            $words"
    ) >"$work/log" 2>&1 || code=$?
    took=$(awk "BEGIN { printf \"%.1f\", ($(date +%s) - $begun) / 60 }")
    echo "| \`$words\` | $code | $took | $(($(killed) - before)) |" >>"$work/table"
    tail -n 3 "$work/log"
done
rmdir "$group"
mv "$work/table" experiments/results/laptop.md
cat experiments/results/laptop.md
