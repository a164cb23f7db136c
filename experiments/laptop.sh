#!/usr/bin/env bash
# README's commands on a small laptop: 8 GB of memory for everything, a home that can't be written,
# no network, the C locale.
#
# Command: sudo bash experiments/laptop.sh (Linux with control groups; after `make demo` has set up
#          the environment, which needs a network)
# Cost:    half an hour on two cores.
# Result:  experiments/results/laptop.md: exit status, minutes, processes killed for memory.
set -uo pipefail
cd "$(dirname "$0")/.."
group=/sys/fs/cgroup/memory/physxnet_laptop
out=experiments/results/laptop.md
work=$(mktemp -d)
mkdir -p "$group" "$work/home"
echo $((8 * 1024 * 1024 * 1024)) >"$group/memory.limit_in_bytes"
printf '| command | exit | minutes | killed for memory |\n|---|---|---|---|\n' >"$work/table"
[ $# -gt 0 ] || set -- "make demo" "make test"
for words in "$@"; do
    begun=$(date +%s)
    (
        echo "$BASHPID" >"$group/cgroup.procs"
        unshare --net --mount bash -c "
            ip link set lo up
            mount --bind '$work/home' '$work/home' && mount -o remount,ro,bind '$work/home'
            export HOME='$work/home' LC_ALL=C LANG=C
            unset XDG_CACHE_HOME
            $words"
    ) >"$work/log" 2>&1
    code=$?
    took=$(awk "BEGIN { printf \"%.1f\", ($(date +%s) - $begun) / 60 }")
    lost=$(awk '/^oom_kill / { print $2 }' "$group/memory.oom_control")
    echo "| \`$words\` | $code | $took | $lost |" >>"$work/table"
    tail -n 3 "$work/log"
done
mv "$work/table" "$out"
cat "$out"
