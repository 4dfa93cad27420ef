# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
# shellcheck shell=bash
#
# Shared by the scripts: messages, stamps of finished steps, and steps that explain their failures.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
venv=$root/.venv
logs=$root/build/setup

# Some containers set this variable. Each of hundreds of processes would then compile its imports.
unset PYTHONDONTWRITEBYTECODE

say() { printf '==> %s\n' "$*"; }
die() { printf '%s: %s\n' "script/$(basename "$0")" "$*" >&2; exit 1; }

# enter_build_folder [NAME]: a lock allows only one setup of this name per source tree. pip unpacks
# gigabytes beside the environment, because /tmp is often a small, separate file system.
enter_build_folder() {
  local name=${1:-setup}
  mkdir -p "$logs" || die "cannot write to $root"
  touch "$root/build/COLCON_IGNORE"
  exec 9>"$root/build/$name.lock"
  flock --nonblock 9 || { say 'waiting for another script/setup in this folder'; flock 9; }
  export TMPDIR=$root/build/tmp_$name
  trap 'rm -rf "$TMPDIR"' EXIT
  rm -rf "$TMPDIR" # left by a killed run
  mkdir "$TMPDIR"
}

# A step is done if its stamp contains the hash of its input. The stamp is written only on success.
hash_of() { find "$@" -type f -not -path '*/__pycache__/*' -print0 | sort -z | xargs -0 sha256sum | sha256sum; }
is_done() { [[ -f $1 && $(<"$1") == "$2" ]]; }
set_done() { printf '%s\n' "$2" > "$1"; }

# run_step NAME COMMAND...: log the output; show large downloads on the terminal too.
run_step() {
  local log=$logs/$1.log
  shift
  "$@" 2>&1 | tee "$log" | show_large_downloads || explain_failure "$log"
}

show_large_downloads() { grep --line-buffered -oE 'Downloading [^ ]+ \([0-9.]+ [GM]B\)' | sed -u 's/^/    /' || true; }

explain_failure() {
  if grep -qiE 'no space left on device|disk quota exceeded' "$1" || (( $(free_mb) < 100 )); then
    die "the disk is full ($(free_mb) MB left for $root): make room and run it again; it continues with this step"
  fi
  if grep -qE 'NewConnectionError|NameResolutionError|ConnectTimeout|ReadTimeout|ConnectionResetError|ProxyError|SSLError|IncompleteRead|ProtocolError|incomplete-download' "$1"; then
    die "the download failed or there is no network: run it again; it continues with this step (log: $1)"
  fi
  tail -n 20 "$1" >&2
  die "this step failed, see above (complete log: $1)"
}

free_mb() { df --output=avail -m "$root" | tail -n 1 | tr -d ' '; }

# pip_install_locked VENV REQUIREMENTS LOCK [PIP OPTION...]: install the releases in a lock file and
# check their hashes. UNLOCKED=1: the newest releases that the requirements allow.
pip_install_locked() {
  local prefix=$1 file=$2 lock=$3
  shift 3
  if [[ -n ${UNLOCKED:-} ]]; then
    pip_install "$prefix" "$root/script/$file.txt" "$@"
  else
    pip_install "$prefix" "$root/script/lock/$lock.txt" --require-hashes
  fi
}

stamp_of() { hash_of "$1" "$root"/script/constraints*.txt; }

# pip_install VENV REQUIREMENTS [PIP OPTION...]: install, unless the file has not changed since.
pip_install() {
  local prefix=$1 file=$2 name hash constraint=()
  shift 2
  name=$(basename "$file" .txt)
  hash=$(stamp_of "$file")
  # Lock files pin every package; other files need the constraints.
  [[ $file == */lock/* ]] || constraint=(--constraint "$root/script/constraints.txt")
  is_done "$prefix/.$name.done" "$hash" && return
  say "installing script/$name.txt with pip"
  # Python compiles a module at its first use, and most modules are never used.
  run_step "$(basename "$prefix")-$name" "$prefix/bin/python" -m pip install --resume-retries 20 \
    --no-compile --disable-pip-version-check --no-input "${constraint[@]}" --requirement "$file" "$@"
  set_done "$prefix/.$name.done" "$hash"
}

# make_venv PYTHON FOLDER [VENV OPTION...]: make a virtual environment, or complete an interrupted one.
make_venv() {
  local python=$1 prefix=$2
  shift 2
  is_done "$prefix/.venv.done" "$prefix" && return
  say "creating ${prefix#"$root/"} with $("$python" --version)"
  run_step "$(basename "$prefix")" "$python" -m venv "$@" "$prefix"
  touch "$prefix/COLCON_IGNORE"
  # Since 25.2, pip resumes an interrupted download within one run.
  run_step "$(basename "$prefix")-pip" "$prefix/bin/python" -m pip install --upgrade 'pip>=25.2'
  set_done "$prefix/.venv.done" "$prefix"
}
