#!/bin/sh
# make-keys NAME=ROLE...: the broker's keys in /keys/broker and those of each service in /keys/NAME, which
# are volumes of their own, so that no service can read another's. What is there already stays.
set -eu
cd /keys
# Public keys come last and in one step: whoever finds one finds all the rest.
[ -f broker/broker.pub ] || { rm -f broker/broker.key && caviar keys new broker --directory broker; }
for pair in "$@"; do
  name=${pair%%=*} role=${pair#*=}
  [ -f "$name/$name.pub" ] || { rm -f "$name/$name.key" && caviar keys new "$name" --directory "$name"; }
  public=$(sed -n 's/^public = //p' "$name/$name.pub")
  grep -qsF "$public" broker/authorized.toml || {
    # A pair made anew, since the volume of the old one is gone, takes its place.
    if grep -qs "^name = \"$name\"" broker/authorized.toml; then caviar keys revoke "$name" --directory broker; fi
    caviar keys authorize "$name/$name.pub" --name "$name" --role "$role" --directory broker
  }
  cmp -s broker/broker.pub "$name/broker.pub" || {
    cp broker/broker.pub "$name/broker.partial"
    mv "$name/broker.partial" "$name/broker.pub"
  }
done
echo "keys are there"
