#!/usr/bin/env bash
# Run one scenario and draw its pictures: deploy/demo.sh [SCENARIO]. FRAMES sets the length.
set -euo pipefail
cd "$(dirname "$0")/.."
scenario=${1:-demo} frames=${FRAMES:-120}
size=""
if [ "$scenario" = demo ]; then size=", which writes about $((4 + frames / 4)) MB"; fi
printf 'running scenario %s for %s frames into runs/%s; then drawing it\n' "$scenario" "$frames" "$size"
.venv/bin/caviar run "$scenario" --frames "$frames"
run=$(ls -td runs/*/ | head -n 1)
.venv/bin/caviar plot "$run" >/dev/null
printf '\nPictures, summary and recording are in %s (%s MB):\n' "$run" "$(du -sm "$run" | cut -f1)"
find "$run" -maxdepth 1 \( -name '*.png' -o -name 'summary.*' -o -name '*.mcap' \) -printf '  %f\n' | sort
