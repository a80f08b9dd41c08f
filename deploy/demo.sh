#!/usr/bin/env bash
# Run one scenario and draw its pictures: deploy/demo.sh [SCENARIO]. FRAMES sets the length.
set -euo pipefail
cd "$(dirname "$0")/.."
.venv/bin/caviar run "${1:-deploy/caviar_scenarios/street-canyon.toml}" --frames "${FRAMES:-120}"
run=$(ls -td runs/*/ | head -n 1)
.venv/bin/caviar plot "$run" >/dev/null
printf '\nPictures, summary and recording are in %s:\n' "$run"
find "$run" -maxdepth 1 \( -name '*.png' -o -name 'summary.*' -o -name '*.mcap' \) -printf '  %f\n' | sort
