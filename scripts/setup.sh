# Sourced by the other scripts: system libraries (when root) and the project in .venv.
# shellcheck shell=bash

# Python 3.10 to 3.12, the newest nerfstudio's dependencies have wheels for.
kronc_python() {
    local candidate
    for candidate in "${PYTHON:-}" python3.11 python3.10 python3.12 python3; do
        if [ -n "$candidate" ] && "$candidate" -c 'import sys, venv; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "error: no Python 3.10 to 3.12 with venv was found: install one (on Debian/Ubuntu: apt-get install python3 python3-venv) or set PYTHON" >&2
    return 2
}

# ffmpeg reads videos; nerfstudio's imports (open3d, OpenCV) load the others.
kronc_system_libraries() {
    local missing=() library known
    known=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p 2>/dev/null || true)
    command -v ffmpeg >/dev/null || missing+=(ffmpeg)
    for library in libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libgomp.so.1:libgomp1 libglib-2.0.so.0:libglib2.0-0; do
        [[ $known == *"${library%%:*}"* ]] || missing+=("${library##*:}")
    done
    [ ${#missing[@]} -eq 0 ] && return
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        echo "installing system packages: ${missing[*]}"
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
    else
        echo "error: system packages are missing; run: sudo apt-get install ${missing[*]}" >&2
        return 2
    fi
}

# kronc_setup [EXTRA]: the project, editable, in .venv; does nothing when pyproject.toml has not changed since.
kronc_setup() {
    local extra=${1:+[$1]} stamp
    kronc_system_libraries
    stamp="$(cat pyproject.toml scripts/setup.sh | cksum) $extra"
    # an installation with extras serves those who need none
    if [ -x .venv/bin/python ] && grep -qF -- "$stamp" .venv/.kronc-setup 2>/dev/null; then
        return
    fi
    echo "installing kronc_ns and nerfstudio into .venv (several GB, once)"
    [ -x .venv/bin/python ] || "$(kronc_python)" -m venv .venv
    .venv/bin/python -m pip install --quiet --upgrade --editable ".$extra" || return
    echo "$stamp" >>.venv/.kronc-setup
}
