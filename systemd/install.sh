#!/bin/sh
# Installs units, users, directories, network files and example configurations; run as root from a checkout:
#   python3 -m venv /opt/servod && /opt/servod/bin/pip install . && systemd/install.sh
# Existing files in /etc/servod are kept. DESTDIR installs below another root (for packages and tests).
set -eu
here=$(cd "$(dirname "$0")" && pwd)
root=${DESTDIR:-}

install -d "$root/etc/udev/rules.d" "$root/etc/systemd/system" "$root/etc/systemd/network" "$root/usr/lib/sysusers.d" "$root/usr/lib/tmpfiles.d"
install -m 644 "$here"/*.service "$root/etc/systemd/system/"
install -m 644 "$here"/80-can0.link "$here"/80-can0.network "$root/etc/systemd/network/"
install -m 644 "$here/90-servod.rules" "$root/etc/udev/rules.d/"
install -m 644 "$here/sysusers.d/servod.conf" "$root/usr/lib/sysusers.d/"
install -m 644 "$here/tmpfiles.d/servod.conf" "$root/usr/lib/tmpfiles.d/"
install -d "$root/etc/servod"
cp -R --no-clobber "$here/../gains/." "$root/etc/servod/"

if [ -z "$root" ]; then
    systemd-sysusers
    systemd-tmpfiles --create
    systemctl daemon-reload
    if command -v udevadm >/dev/null; then udevadm control --reload && udevadm trigger --sysname-match=cpu_dma_latency; fi
fi
sync # an empty file that a power cut leaves would be kept by the next run
