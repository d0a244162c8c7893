#!/usr/bin/env bash
# Runs commands on a fresh machine: a minimal Debian in a folder, with Python 3.12 or newer, pip and git, and nothing else.
#
#   fresh.sh [-d FOLDER] [-s SUITE] [-u] COMMAND…
#
# Each COMMAND runs in a clone of this checkout, as committed, in a login shell: as root, or with -u as an ordinary user.
# FOLDER is made, or used again as it was left (default: a temporary one, deleted at the end). SUITE is a Debian release
# (default: this machine's). Packages come from where this machine's apt, pip and uv get them. Needs Debian, root,
# debootstrap, and 3 GB (20 GB for all checks). Exits with the status of the last COMMAND that failed, or 0.
set -euo pipefail

fail() {
  echo "fresh.sh: $1" >&2
  exit 2
}

folder='' suite='' user=root
while getopts d:s:u option; do
  case $option in
    d) folder=$OPTARG ;;
    s) suite=$OPTARG ;;
    u) user=tester ;;
    *) exit 2 ;;
  esac
done
[ "$#" -ge "$OPTIND" ] || fail "which command?"
[ "$(id -u)" = 0 ] || fail "needs root"
[ -f /etc/debian_version ] || fail "needs Debian, whose settings of apt it takes over"
command -v debootstrap >/dev/null || fail "needs debootstrap: sudo apt-get install debootstrap"

# Again in namespaces of its own, where mounts and processes end with the last command.
if [ -z "${FRESH_CHECKOUT:-}" ]; then
  FRESH_CHECKOUT=$(git -C "$(dirname "$0")" rev-parse --show-toplevel)
  FRESH_PYTHON=$(python3.12 -c 'import sys; print(sys.base_prefix)' 2>/dev/null || true)
  export FRESH_CHECKOUT FRESH_PYTHON
  scratch=$(mktemp -d)
  trap 'rm -rf --one-file-system "$scratch"' EXIT
  status=0
  unshare --mount --pid --ipc --fork --kill-child --propagation private \
    "$0" -d "$scratch/fresh" "$@" || status=$?
  exit "$status"
fi
shift $((OPTIND - 1))
trap 'exit 130' INT TERM # the first process of a namespace ignores what it does not trap

inside() { chroot "$folder" "$@"; }

install_debian() {
  local here mirror path
  here=$(. /etc/os-release && echo "$VERSION_CODENAME")
  : "${suite:=$here}"
  mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' "Release: $here" | head -n 1)
  [ -n "$mirror" ] || fail "apt has no lists of $here: sudo apt-get update"
  mkdir -p "$folder"
  # Python of Debian's brings the libraries that any Python is linked with.
  debootstrap --variant=minbase --include=ca-certificates,git,python3,python3-pip,python3-venv \
    "$suite" "$folder" "$mirror" >"$folder/debootstrap.log" || fail "debootstrap failed, see $folder/debootstrap.log"
  if [ "$suite" = "$here" ]; then
    rm -rf "$folder"/etc/apt/sources.list*
    for path in /etc/apt/sources.list*; do cp -aL "$path" "$folder/etc/apt/"; done
  fi
  for path in /etc/apt/apt.conf.d/*; do
    if grep -qs '^ *Acquire' "$path"; then cp "$path" "$folder$path"; fi
  done
  for path in /etc/apt/{trusted.gpg.d,auth.conf.d} /etc/{pip.conf,uv,resolv.conf,hosts} /usr/local/share/ca-certificates; do
    if [ -e "$path" ]; then cp -aL "$path" "$folder${path%/*}/"; fi
  done
  inside update-ca-certificates >/dev/null 2>&1
  inside useradd --create-home --shell /bin/bash tester
}

# Where Debian's is too old, this machine's, without any package but pip.
install_python() {
  local paths='' parent=$FRESH_PYTHON
  if ! inside python3 -c 'import sys; sys.exit(sys.version_info < (3, 12))'; then
    [ -n "$FRESH_PYTHON" ] || fail "Debian's Python is older than 3.12, and there is no python3.12 here to take"
    mkdir -p "$folder$FRESH_PYTHON"
    tar -C "$FRESH_PYTHON" --exclude='site-packages/*' --exclude=__pycache__ --exclude='bin/pip*' --exclude='bin/uv*' \
      -cf - . | tar -C "$folder$FRESH_PYTHON" -xf -
    while [ "$parent" != / ]; do
      chmod a+rx "$folder$parent"
      parent=$(dirname "$parent")
    done
    inside "$FRESH_PYTHON/bin/python3.12" -m ensurepip --default-pip >/dev/null 2>&1
    paths=$FRESH_PYTHON/bin:
  fi
  echo "export PATH=$paths\$HOME/.local/bin:\$PATH" >"$folder/etc/profile.d/python.sh"
}

mount_devices() {
  local device
  mount --bind "$folder" "$folder"
  mount -t proc proc "$folder/proc"
  mount --rbind /sys "$folder/sys"
  mount -t tmpfs -o mode=755 dev "$folder/dev"
  mkdir "$folder"/dev/{pts,shm}
  mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$folder/dev/pts"
  mount -t tmpfs -o mode=1777 shm "$folder/dev/shm"
  for device in null zero full random urandom tty; do
    touch "$folder/dev/$device"
    mount --bind "/dev/$device" "$folder/dev/$device"
  done
  ln -s pts/ptmx "$folder/dev/ptmx"
  ln -s /proc/self/fd "$folder/dev/fd"
  for device in 0:stdin 1:stdout 2:stderr; do ln -s "fd/${device%:*}" "$folder/dev/${device#*:}"; done
}

# Nothing of this environment but the settings of package clients.
run() {
  local variable settings=(HOME="$home" USER="$user" LANG=C.UTF-8 TERM="${TERM:-dumb}" DEBIAN_FRONTEND=noninteractive)
  while IFS= read -r -d '' variable; do
    case $variable in
      PIP_* | UV_* | SSL_CERT_* | REQUESTS_CA_BUNDLE=* | *_proxy=* | *_PROXY=*) settings+=("$variable") ;;
    esac
  done < <(env -0)
  # shellcheck disable=SC2016 # expanded inside
  inside setpriv --reuid "$user" --regid "$user" --init-groups env -i "${settings[@]}" \
    bash -lc 'cd ~/ibrobot && eval "$0"' "$1"
}

if [ ! -e "$folder/.fresh" ]; then
  install_debian
  install_python
  touch "$folder/.fresh"
fi
mount_devices
home=$(inside getent passwd "$user" | cut -d: -f6)
if [ ! -e "$folder$home/ibrobot" ]; then
  git clone -q --no-hardlinks "$FRESH_CHECKOUT" "$folder$home/ibrobot"
  inside chown -R "$user:" "$home"
fi
status=0
for command in "$@"; do
  echo "fresh.sh: $user\$ $command"
  run "$command" || status=$?
  echo "fresh.sh: status $status after $SECONDS s"
done
exit "$status"
