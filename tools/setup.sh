#!/bin/sh
# Creates the virtual environment $1 with this package and all dependencies, at the versions in the constraints file $2
# (default: constraints.txt; /dev/null: the newest), and installs the system packages that nerfstudio's renderer
# (ffmpeg) and exporter (libusb, for open3d) need.
set -eu
venv=$1
constraints=${2:-constraints.txt}

find_python() {
    for candidate in ${PYTHON:-python3.11 python3.10 python3.12 python3}; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "error: no Python 3.10 to 3.12 found; install one (3.11 is the tested one) or name it with PYTHON=..." >&2
    exit 2
}

missing=""
command -v ffmpeg >/dev/null 2>&1 || missing="$missing ffmpeg"
if [ "$(uname)" = Linux ]; then
    (PATH=$PATH:/sbin:/usr/sbin ldconfig -p 2>/dev/null) | grep -q 'libusb-1.0.so.0' || missing="$missing libusb-1.0-0"
fi
if [ -n "$missing" ]; then
    sudo=""
    [ "$(id -u)" = 0 ] || sudo="sudo -n"
    # shellcheck disable=SC2086
    if command -v apt-get >/dev/null 2>&1 && $sudo true 2>/dev/null \
        && $sudo apt-get update -qq && $sudo apt-get install -y -qq $missing >/dev/null; then
        echo "installed system packages:$missing"
    else
        echo "note: please install these system packages:$missing (ns-render needs ffmpeg, ns-export needs libusb)" >&2
    fi
fi

python=$(find_python)
"$python" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --constraint "$constraints" --editable '.[dev]'
