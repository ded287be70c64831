#!/usr/bin/env bash
# Sets up .venv: `scripts/setup.sh runtime` to run fgslam, `scripts/setup.sh dev` to work on it.
# Meant for `make`, which keeps the stamps. FGSLAM_PYTHON=/path/to/python chooses the interpreter.
set -euo pipefail
cd "$(dirname "$0")/.."

kind="${1:-dev}"

say() { printf 'setup: %s\n' "$*" >&2; }
fail() {
  say "$*"
  exit 1
}

can_apt() { [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null 2>&1; }

# Quiet unless it fails; the caller says what the failure means.
apt_install() {
  local log
  log="$(mktemp)"
  if { apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
    apt-get install -y -qq --no-install-recommends "$@"; } >"$log" 2>&1 </dev/null; then
    rm -f "$log"
    return 0
  fi
  tail -n 3 "$log" >&2
  rm -f "$log"
  return 1
}

# A name on the PATH is not enough: version managers leave names there that do not run.
is_supported() {
  "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' >/dev/null 2>&1
}

find_python() {
  local candidate
  for candidate in ${FGSLAM_PYTHON:-python3.11 python3.12 python3.13 python3 python}; do
    if is_supported "$candidate"; then
      printf '%s' "$candidate"
      return 0
    fi
  done
  return 1
}

can_make_environments() { "$1" -c 'import ensurepip, venv' >/dev/null 2>&1; }

provide_python() {
  if ! python="$(find_python)"; then
    if can_apt && [ -z "${FGSLAM_PYTHON:-}" ]; then
      say "no Python 3.11 to 3.13 found: installing python3-venv with apt-get"
      apt_install python3-venv || true
    fi
    python="$(find_python)" || fail "Python 3.11, 3.12 or 3.13 is needed and none was found;" \
      "install one, or name it: make setup FGSLAM_PYTHON=/path/to/python"
  fi
  can_make_environments "$python" && return 0
  local package
  package="python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
  if can_apt; then
    say "$python lacks ensurepip: installing $package with apt-get"
    apt_install "$package" || true
  fi
  can_make_environments "$python" || fail "$python cannot make virtual environments (no ensurepip);" \
    "install the package $package, or name another Python: make setup FGSLAM_PYTHON=/path/to/python"
}

provide_environment() {
  if is_supported .venv/bin/python && .venv/bin/python -m pip --version >/dev/null 2>&1; then
    return 0
  fi
  provide_python
  say "making .venv with $("$python" --version)"
  "$python" -m venv --clear .venv
}

install_package() {
  local target="." what="fgslam and what it runs on"
  if [ "$kind" = dev ]; then
    target=".[dev]"
    what="the development tools"
  fi
  say "installing $what (minutes the first time)"
  # Twice quiet: errors only.
  .venv/bin/python -m pip install -qq --disable-pip-version-check --editable "$target" </dev/null ||
    fail "pip could not install what pyproject.toml asks for (see above);" \
      "check the connection to the package index and run make again"
}

# Open3D renders the lab; all else runs without it, so that nothing here is an error.
provide_system_libraries() {
  local packages
  packages="$(.venv/bin/python -m fgslam.core.open3d_library --packages)" || true
  if [ -n "$packages" ] && can_apt; then
    say "installing the system libraries that Open3D lacks here: $packages"
    # shellcheck disable=SC2086  # a list of package names
    apt_install $packages || true
  fi
  .venv/bin/python -m fgslam.core.open3d_library >&2 || true
}

case "$kind" in
  runtime | dev) ;;
  *) fail "unknown kind '$kind'; use runtime or dev" ;;
esac
provide_environment
install_package
[ "$kind" = runtime ] && provide_system_libraries
touch ".venv/.$kind-stamp"
