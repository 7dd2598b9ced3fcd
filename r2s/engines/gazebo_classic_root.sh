#!/bin/sh
# Make a root directory with Gazebo Classic 11 and its headers: Debian 11 (bullseye) in FOLDER, about 2.7 GB.
# Needs debootstrap and root (sudo). Nothing outside FOLDER changes, and nothing is mounted.
#     sudo sh r2s/engines/gazebo_classic_root.sh FOLDER
# MIRROR=URL replaces debootstrap's default mirror of Debian.
set -eu

fail() {
    echo "error: $1" >&2
    exit 2
}

[ $# -eq 1 ] || fail "expected one argument, the new root directory; got $#"
[ "$(id -u)" = 0 ] || fail "debootstrap and chroot need root: sudo sh $0 $1"
command -v debootstrap > /dev/null || fail "debootstrap is not installed: sudo apt-get install debootstrap"
root=$1
[ ! -e "$root" ] || [ -z "$(ls -A "$root")" ] || fail "$root exists and is not empty"

debootstrap --variant=minbase bullseye "$root" ${MIRROR:+"$MIRROR"}
cp /etc/resolv.conf "$root/etc/resolv.conf"
echo force-unsafe-io > "$root/etc/dpkg/dpkg.cfg.d/r2s"  # a third of the time; only the new folder is at risk
# no service may start in the root directory
printf '#!/bin/sh\nexit 101\n' > "$root/usr/sbin/policy-rc.d"
chmod +x "$root/usr/sbin/policy-rc.d"
DEBIAN_FRONTEND=noninteractive chroot "$root" sh -ec '
    apt-get update
    apt-get install --yes --no-install-recommends gazebo libgazebo-dev gazebo-plugin-base g++ pkg-config
    apt-get clean
'
echo "written: $root; next: make gazebo-classic R2S_GAZEBO_ROOT=$root"
