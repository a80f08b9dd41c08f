#!/bin/sh
# Run a world without a screen so that SIGTERM makes it say BYE: scripts of Godot see no signals.
#
#     run_headless.sh SCRIPT.gd ARGUMENTS…      in the folder of the project; GODOT names the program
#
# The world ends when the file exists that CAVIAR_STOP_FILE names.
CAVIAR_STOP_FILE=$(mktemp -u "${TMPDIR:-/tmp}/caviar-stop-XXXXXXXX")
export CAVIAR_STOP_FILE
trap 'touch "$CAVIAR_STOP_FILE"' TERM INT
${GODOT:-godot3-server} -s "$@" & # GODOT may have options, such as --path
# A trap ends `wait` before the world has ended.
while :; do
  wait $!
  status=$?
  kill -0 $! 2>/dev/null || break
done
if [ -e "$CAVIAR_STOP_FILE" ]; then
  rm -f "$CAVIAR_STOP_FILE"
  status=143
fi
exit $status
