#!/bin/sh
# Set up Python, Numba and SciPy for aarch64 in a folder, without changing this system. Usage: setup.sh FOLDER
# Needs Debian's apt-get and dpkg (no root), python3 with pip, and their package servers.
set -eu
folder=$(mkdir -p "$1" && cd "$1" && pwd)
python=${PYTHON:-python3}
[ -e "$folder/ready" ] && exit 0

for tool in apt-get dpkg "$python"; do
    command -v "$tool" > /dev/null || { echo "test-arm: $tool is missing; run this on Debian or Ubuntu" >&2; exit 2; }
done

# A private state of apt, with only one architecture, so that the system's packages do not matter.
get() { # ARCHITECTURE PACKAGE...
    state="$folder/apt/$1" options="-q=2 -o APT::Architecture=$1 -o APT::Architectures=$1 -o APT::Sandbox::User="
    mkdir -p "$state/lists/partial" "$state/cache/archives/partial" "$state/debs"
    : > "$state/status"
    options="$options -o Dir::State=$state -o Dir::State::Lists=$state/lists -o Dir::State::status=$state/status"
    options="$options -o Dir::Cache=$state/cache"
    shift
    apt-get $options update > "$state/log" 2>&1 || { cat "$state/log" >&2; missing "lists of Debian packages"; }
    (cd "$state/debs" && apt-get $options download "$@") > "$state/log" 2>&1 || { cat "$state/log" >&2; missing "$*"; }
    for deb in "$state"/debs/*.deb; do dpkg -x "$deb" "$folder/root"; done
}
missing() {
    echo "test-arm: cannot download $1; check the network and the package servers" >&2
    exit 2
}

version=$(. /etc/os-release && echo "$VERSION_ID")
[ "$version" = 12 ] || echo "test-arm: written for Debian 12 with its Python 3.11; this is ${version:-another system}" >&2
get amd64 qemu-user-static
get arm64 libpython3.11-minimal libpython3.11-stdlib python3.11-minimal libc6 libgcc-s1 libstdc++6 zlib1g libexpat1 \
    libssl3 libffi8 libbz2-1.0 liblzma5 libsqlite3-0 libuuid1 libgomp1 libcrypt1 libdb5.3

tags="--platform manylinux2014_aarch64 --platform manylinux_2_27_aarch64 --platform manylinux_2_28_aarch64"
needs=$("$python" -c "
from importlib.metadata import requires
print(*(each.replace(' ', '') for each in requires('ertis-numba') if 'extra' not in each))")
"$python" -m pip download --quiet --dest "$folder/wheels" --only-binary=:all: $tags --python-version 311 \
    --implementation cp --abi cp311 --abi abi3 --abi none $needs pytest pytest-timeout hypothesis \
    > "$folder/log" 2>&1 || { cat "$folder/log" >&2; missing "wheels for aarch64"; }
for wheel in "$folder"/wheels/*.whl; do "$python" -m zipfile -e "$wheel" "$folder/site"; done
touch "$folder/ready"
