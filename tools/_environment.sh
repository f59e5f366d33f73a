# Sourced by the tools: makes and keeps the virtual environment in .venv.
# Usage: prepare_environment EXTRA     (test, top)

project=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$project/.venv

find_python() {
    local candidate
    for candidate in python3.13 python3.12 python3.11 python3; do
        if command -v "$candidate" >/dev/null &&
            "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "Python 3.11 or newer is needed (Debian and Ubuntu: apt install python3 python3-venv)" >&2
    return 1
}

# the compiled libraries that exist and are no older than their sources
compiled() {
    local library
    for library in "$project"/skinware*/native/*.so; do
        [ ! -e "$library" ] ||
            [ -n "$(find "$project"/skinware*/native "$project/skinware/include" -name '*.[ch]' -newer "$library")" ] ||
            echo "$library"
    done
}

prepare_environment() {
    local extra=$1 wanted stamp
    wanted=$(cat "$project"/{pyproject.toml,setup.py,skinware*/native/*.[ch],skinware/include/*.h} | cksum)
    stamp=$venv/installed-$extra
    if [ -x "$venv/bin/python" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted $(compiled)" ] &&
        "$venv/bin/python" -c 'import skinware' 2>/dev/null; then
        return
    fi
    if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        local python
        python=$(find_python)
        echo "making $venv" >&2
        rm -rf "$venv"
        if ! "$python" -m venv --upgrade-deps "$venv"; then # a newer pip installs in half the time
            echo "$python cannot make virtual environments (Debian and Ubuntu: apt install python3-venv)" >&2
            return 1
        fi
    fi
    echo "installing skinware[$extra]" >&2
    # uv installs in half the time; it does not read pip's configuration, so pip installs where uv cannot
    if ! { "$venv/bin/python" -m pip install -qq uv && "$venv/bin/uv" pip install --quiet --python "$venv" --editable "$project[$extra]"; } 2>/dev/null; then
        "$venv/bin/python" -m pip install -qq --no-compile --editable "$project[$extra]" # Python compiles what it imports
    fi
    echo "$wanted $(compiled)" >"$stamp"
}
