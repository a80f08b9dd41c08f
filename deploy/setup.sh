#!/usr/bin/env bash
# Make .venv with what `make demo` needs (deploy/setup.sh demo), or `make test` too (deploy/setup.sh dev),
# and see to the system libraries that pip does not bring. `deploy/setup.sh engines` sees to the compilers and engines
# with which the client libraries are tested, and makes no .venv. Installs Debian packages where it may (as root, or with
# passwordless sudo); otherwise it names the command and fails.
set -euo pipefail
cd "$(dirname "$0")/.."

case ${1:-dev} in
  demo) extras=all what="ray tracer, SUMO and Matplotlib" size=1500 stamp=.venv/.setup-demo ;;
  dev) extras=all,dev what="ray tracer, SUMO, Matplotlib, PyTorch and the tools of the tests" size=2500 stamp=.venv/.setup-done ;;
  engines) ;;
  *) echo "usage: deploy/setup.sh [demo|dev|engines]" >&2 && exit 2 ;;
esac

say() { printf '\033[1m==>\033[0m %s\n' "$*"; }
die() {
  printf '\033[1;31merror:\033[0m %s\n' "$*" >&2
  exit 1
}

as_root() {
  if [ "$(id -u)" -eq 0 ]; then "$@"; else sudo -n "$@"; fi
}

# Install Debian packages, or end with the command that does.
need_packages() {
  local why=$1
  shift
  local command="sudo apt-get update && sudo apt-get install -y --no-install-recommends $*"
  command -v apt-get >/dev/null || die "$why. Install what these Debian packages hold: $*"
  if [ "$(id -u)" -ne 0 ] && ! sudo -n true 2>/dev/null; then
    die "$why. Install it, then run this again: $command"
  fi
  say "$why: installing $*"
  local log
  log=$(mktemp)
  if ! { as_root apt-get update -qq && as_root env DEBIAN_FRONTEND=noninteractive \
    apt-get install -y -qq --no-install-recommends "$@"; } >"$log" 2>&1; then
    tail -n 15 "$log" >&2
    die "apt-get failed (log: $log). Mend it and run this again, or try by hand: $command"
  fi
  rm -f "$log"
}

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }
tested() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; }

# PYTHON, or the python3 that is first in PATH if this project is tested with its version, or one that is.
find_python() {
  local candidate
  if [ -n "${PYTHON:-}" ]; then
    command -v "$PYTHON"
    return
  fi
  for candidate in python3 python3.13 python3.12 python3.11; do
    if tested "$candidate"; then
      command -v "$candidate"
      return
    fi
  done
  if new_enough python3; then command -v python3; fi
}

# Whether .venv is there, works, and is of the Python that PYTHON names, if it names one.
venv_fits() {
  { [ -x .venv/bin/python ] && .venv/bin/python -m pip --version && new_enough .venv/bin/python; } >/dev/null 2>&1 || return
  local has wanted
  [ -n "${PYTHON:-}" ] || return 0
  has=$(.venv/bin/python --version) wanted=$("$PYTHON" --version)
  [ "$has" = "$wanted" ] || { say ".venv has $has, PYTHON=$PYTHON is $wanted: making .venv again" && false; }
}

make_venv() {
  local python
  python=$(find_python)
  if [ -z "$python" ]; then
    need_packages "no Python of version 3.11 or newer was found" python3 python3-venv
    python=$(find_python)
    [ -n "$python" ] || die "apt brought no Python ≥ 3.11; install one and run: make setup PYTHON=/path/to/python"
  fi
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    need_packages "$python cannot create virtual environments" python3-venv
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
      die "$python has no ensurepip; use another one: make setup PYTHON=/usr/bin/python3"
  fi
  say "creating .venv with $("$python" --version)"
  rm -rf .venv
  "$python" -m venv .venv
}

# Names of shared libraries that a file asks for and the system does not have.
missing_libraries() {
  ldd "$@" 2>/dev/null | awk '/not found/ { print $1 }' | sort -u
}

package_of() {
  case $1 in
    libX11.so.6) echo libx11-6 ;;
    libXext.so.6) echo libxext6 ;;
    libXrender.so.1) echo libxrender1 ;;
    libXcursor.so.1) echo libxcursor1 ;;
    libXfixes.so.3) echo libxfixes3 ;;
    libXft.so.2) echo libxft2 ;;
    libXrandr.so.2) echo libxrandr2 ;;
    libGL.so.1) echo libgl1 ;;
    libGLU.so.1) echo libglu1-mesa ;;
    libGLX.so.0) echo libglx0 ;;
    libGLdispatch.so.0) echo libglvnd0 ;;
    libatomic.so.1) echo libatomic1 ;;
    libexpat.so.1) echo libexpat1 ;;
    libgomp.so.1) echo libgomp1 ;;
    libstdc++.so.6) echo libstdc++6 ;;
    libz.so.1) echo zlib1g ;;
    *) return 1 ;;
  esac
}

see_to_shared_libraries() {
  local site library packages=() unknown=()
  site=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("platlib"))')
  for library in $(missing_libraries "$site"/sumo/bin/{sumo,netconvert,netgenerate} \
    "$site"/libsumo/*.so "$site"/mitsuba/llvm_ad_*.so "$site"/mitsuba/libmitsuba.so "$site"/drjit/*.so); do
    if package=$(package_of "$library"); then packages+=("$package"); else unknown+=("$library"); fi
  done
  if [ ${#packages[@]} -gt 0 ]; then
    need_packages "shared libraries of the traffic simulator and the ray tracer are missing" "${packages[@]}"
  fi
  if [ ${#unknown[@]} -gt 0 ]; then
    say "note: these shared libraries were not found; 'caviar doctor' shows whether it matters: ${unknown[*]}"
  fi
}

# The first that the package lists hold; 19 is the one this project is tested with.
llvm_package() {
  local version
  for version in 19 20 18 17 16; do
    if apt-cache show "libllvm$version" >/dev/null 2>&1; then
      echo "libllvm$version"
      return
    fi
  done
  echo libllvm19
}

see_to_llvm() {
  local choose='from caviar_services.drjit_setup import choose_llvm; print(choose_llvm())'
  if ! .venv/bin/python -c "$choose" >/dev/null 2>&1; then
    need_packages "the ray tracer compiles with libLLVM ≥ 16, which is missing" "$(llvm_package)"
  fi
  say "$(.venv/bin/python -c "$choose")"
}

# Debian's package of each program; tests that lack one are skipped by its name.
see_to_engines() {
  local program missing=()
  for program in g++:g++ node:nodejs mcs:mono-mcs mono:mono-runtime godot3-server:godot3-server \
    chromium:chromium; do
    command -v "${program%%:*}" >/dev/null || missing+=("${program##*:}")
  done
  [ -e /usr/include/zmq.h ] || missing+=(libzmq3-dev)
  for program in "${missing[@]}"; do
    # What Mono's sockets call, which its runtime does not bring.
    if [ "$program" = mono-runtime ]; then missing+=(libmono-posix4.0-cil libmono-system4.0-cil); fi
  done
  if [ ${#missing[@]} -gt 0 ]; then
    need_packages "the tests of client libraries and of the viewer use ${missing[*]}" "${missing[@]}"
  fi
}

if [ "${1:-dev}" = engines ]; then
  see_to_engines
  exit
fi
if [ -n "${PYTHON:-}" ] && ! new_enough "$PYTHON"; then
  die "PYTHON=$PYTHON is no Python of version 3.11 or newer"
fi
if ! venv_fits; then make_venv; fi
say "installing into .venv: $what ($size MB; a few minutes the first time)"
.venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".[$extras]"
see_to_shared_libraries
see_to_llvm
touch "$stamp"
say "ready: .venv/bin/caviar doctor shows what this machine has"
