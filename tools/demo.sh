#!/usr/bin/env bash
# Run one scenario and draw its pictures: tools/demo.sh [SCENARIO]. FRAMES sets the length.
set -euo pipefail
cd "$(dirname "$0")/.."
.venv/bin/caviar run "${1:-deploy/scenarios/street-canyon.toml}" --frames "${FRAMES:-120}"
run=$(ls -td runs/*/ | head -n 1)
.venv/bin/caviar plot "$run"
printf '\nThe run is in %s:\n' "$run"
find "$run" -maxdepth 2 -type f | sort
