#!/bin/bash
# Runs the commands of README's "With your own scene" as printed, in a new Debian 12 root file system with nothing but Rust,
# on a labelled scene beside the project. What cannot be had (a model hub, a Qdrant server) is replaced or left out, and said.
# Needs root, debootstrap and rustup. usage: newcomer.sh [ROOT]       ROOT: an empty folder to use, which stays
set -euo pipefail
cd "$(dirname "$0")/.."
project=$PWD
scene=$project/../shared/scenes/house_a
work=$(mktemp -d)
root=${1:-$work/root}
clean_up() {
    [ -z "$(jobs -p)" ] || kill $(jobs -p) 2>/dev/null || true
    for mounted in proc dev root/.rustup root/.cargo/registry; do umount --lazy "$root/$mounted" 2>/dev/null || true; done
    # What is still mounted is this machine's own, on the same file system.
    ! grep -q " $root/" /proc/mounts || { echo "newcomer: $root has mounts left; nothing is removed" >&2; return; }
    rm -rf --one-file-system "$work"
}
trap clean_up EXIT
command -v debootstrap >/dev/null || { echo "newcomer: needs debootstrap; run scripts/setup.sh packages" >&2; exit 1; }
[ -d "$scene" ] || { echo "newcomer: there is no $scene" >&2; exit 1; }

jetson/root.sh amd64 "$root" ca-certificates,curl,git
cp /etc/resolv.conf "$root/etc/"
cp -r /etc/apt/sources.list* /etc/apt/apt.conf.d "$root/etc/apt/"
# Mirrors of this machine may be signed by its own authority, and named in its settings of pip and npm.
cp -r /usr/local/share/ca-certificates "$root/usr/local/share/"
for settings in /etc/pip.conf "$HOME/.npmrc"; do [ ! -f "$settings" ] || cp "$settings" "$root$settings"; done
chroot "$root" update-ca-certificates >/dev/null 2>&1
mkdir -p "$root/root/.rustup" "$root/root/.cargo/registry" "$root/root/.cargo/bin"
mount -t proc proc "$root/proc"
mount --bind /dev "$root/dev"
mount --bind "${RUSTUP_HOME:-$HOME/.rustup}" "$root/root/.rustup"
mount --bind "${CARGO_HOME:-$HOME/.cargo}/registry" "$root/root/.cargo/registry"
cp -a "${CARGO_HOME:-$HOME/.cargo}"/bin/. "$root/root/.cargo/bin/"
[ ! -f "${CARGO_HOME:-$HOME/.cargo}/config.toml" ] || cp "${CARGO_HOME:-$HOME/.cargo}/config.toml" "$root/root/.cargo/"
git clone --quiet "$project" "$root/root/slag"
mkdir "$root/root/data"
cp -r "$scene"/point_cloud.ply "$scene"/sparse "$scene"/images "$root/root/data/"
cp "$scene/point_cloud.ply" "$root/root/data/scene.ply"

# The commands of the section, continued lines joined, without comments.
sed -n '/^## With your own scene/,/^## Figures/p' README.md | sed -n 's/^    *//p' |
    sed -n '/^\(\.\/install\|export\|slag-\|--\)/p' | sed -e ':a' -e '/\\$/N; s/\\\n *//; ta' -e 's/ *# .*$//' >"$work/commands"
grep -q . "$work/commands" || { echo "newcomer: README has no commands" >&2; exit 1; }

# Variables of this machine that name mirrors and proxies pass on.
run=(chroot "$root" /usr/bin/env -u PIP_FIND_LINKS HOME=/root PIP_DISABLE_PIP_VERSION_CHECK=1
    PATH=/root/.cargo/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin bash -euo pipefail -c)
inside() { "${run[@]}" "$1" </dev/null; }
replaced=()
before="cd /root/slag"
while read -r command; do
    as_printed=$command
    case $command in
    ./install.sh*)
        inside "cd /root/slag && $command"
        before="cd /root/data"
        ;;
    export*) before="$before && $command" ;;
    *"models pull"*) replaced+=("left out, no hub is reached: $as_printed") ;;
    *qdrant*) replaced+=("left out, no Qdrant runs: $as_printed") ;;
    *)
        command=${command//BASE/127.0.0.1}
        command=${command//--models clip-vit-base-patch32-int8 --text-model/}
        [ "$command" = "$as_printed" ] || replaced+=("run as: $command")
        echo "newcomer: $command"
        case $command in
        "slag-encoder serve"* | "slag-encoder view"* | "slag-edge serve"*)
            [[ $command != *view* ]] || command="$command --no-open"
            # In place of the subshell, so that a signal to the job reaches the program.
            (exec "${run[@]}" "$before && exec $command" </dev/null >"$work/service" 2>&1) &
            for _ in $(seq 120); do
                grep -q '127.0.0.1\|listening' "$work/service" && break
                sleep 0.5
            done
            grep -q '127.0.0.1\|listening' "$work/service" || { cat "$work/service" >&2; exit 1; }
            case $command in
            *"slag-edge serve")
                reply=$(inside "curl --silent --fail --show-error 'http://127.0.0.1:7734/query?text=chair&near=12.5,-3,0'")
                [[ $reply == *'"answers":[{'* ]] || { echo "newcomer: no answer in $reply" >&2; exit 1; }
                kill %%
                wait %% 2>/dev/null || true
                ;;
            *"slag-encoder view"*) kill %%; wait %% 2>/dev/null || true ;;
            esac
            ;;
        *) inside "$before && $command" ;;
        esac
        ;;
    esac
done <"$work/commands"
printf 'newcomer: %s\n' "${replaced[@]}" "all commands of README ran"
