#!/bin/sh
# The paper's system without its hardware: four emulated sensors around a platform on one SYNC chain, a sensor node that
# takes their measurements, a central node that stores them and makes images, an application that listens.
set -eu
cd "$(dirname "$0")/.."
rm -rf demo && mkdir demo

nodes=
begin() { # a node in the background, until it has said that it is ready
    told=$1
    shift
    "$@" >"$told" &
    nodes="$! $nodes"
    until [ -s "$told" ]; do
        kill -0 $!
        sleep 0.1
    done
}
end() { # nodes that are still there, the latest first
    for node in $nodes; do
        kill "$node" && wait "$node" || true
    done 2>/dev/null
    nodes=
}
trap end EXIT
said() { sed -n "s/.*\"$2\": \"\([^\"]*\)\".*/\1/p" "$1" | head -n 1; }

export ERTIS_EMULATED_DIR="$PWD/demo/sensors" # where the links to emulated sensors lie
begin demo/emulate.jsonl ertis emulate examples/platform.toml --sync-rate 10 --json --quiet
begin demo/serve.jsonl ertis serve --listen tcp://127.0.0.1:0 --publish tcp://127.0.0.1:0 --record demo/recordings --json --quiet
central=$(said demo/serve.jsonl address) images=$(said demo/serve.jsonl publish)
echo 'waiting for the workers: the first run compiles kernels ...' >&2
until ertis status "$central" --json | grep -q '"state": "idle"'; do
    sleep 0.5
done
begin demo/heard.jsonl ertis listen "$images" --json --quiet

set -x
ertis devices
ertis capture --port front --port left --port back --port right --trigger sync -n 50 --to "$central" --mounting examples/platform.toml
ertis status "$central"
{ set +x; } 2>/dev/null
end
set -x

ertis verify demo/recordings/*.h5 || [ $? -eq 3 ] # gaps: what came too late for a busy machine is told, the rest sound
ertis process demo/recordings/*.h5 --sensor front --output demo/image.h5 --directions 2d:181 --force
ertis peaks demo/image.h5 --measurement 0
ertis plot demo/image.h5 --output demo/image.png --force
