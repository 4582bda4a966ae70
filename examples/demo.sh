#!/bin/sh
# The whole way without hardware: an emulated sensor, a capture from it by the real driver, an image, its reflectors.
set -eu
cd "$(dirname "$0")/.."
mkdir -p demo

# With a real sensor, leave this paragraph out and give its port below: /dev/ttyACM0, or its serial number.
rm -f demo/port
ertis emulate data/synthetic/reflectors.h5 --link demo/sensor --quiet >demo/port &
emulator=$!
trap '{ set +x; kill $emulator; wait $emulator; } 2>/dev/null || true' EXIT
until [ -s demo/port ]; do # it prints its port when it is ready
    kill -0 $emulator
    sleep 0.1
done

set -x
ertis devices --port demo/sensor
ertis capture --port demo/sensor -n 5 --output demo/captured.h5 --force
ertis verify demo/captured.h5
ertis process demo/captured.h5 --output demo/image.h5 --directions 2d:181 --force
ertis peaks demo/image.h5 --measurement 0
ertis plot demo/image.h5 --output demo/image.png --force
