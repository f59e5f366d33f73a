# Sourced by the tools: Debian packages that they need and that pip cannot give them.
# Usage: COMMAND_IS_THERE || install_packages "for what" PACKAGE...    (as root, unless may_install=no)

may_install=yes
lock_wait_s=600
lists_are_new=no

# install_packages "for what" PACKAGE...: as root; otherwise says what to type, and fails.
install_packages() {
    local purpose=$1
    shift
    if [ "$may_install" = yes ] && [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        echo "installing $* ($purpose)" >&2
        [ "$lists_are_new" = yes ] || apt_get update || return 1
        lists_are_new=yes
        apt_get install --yes --no-install-recommends "$@"
        return
    fi
    echo "missing $purpose; on Debian and Ubuntu:" >&2
    echo "    sudo apt-get update && sudo apt-get install --no-install-recommends $*" >&2
    return 1
}

# apt_get ARGUMENTS...: waits for another apt, whichever of its locks that one has (DPkg::Lock::Timeout knows but one).
apt_get() {
    local messages deadline=$((SECONDS + lock_wait_s)) waiting=no
    while ! messages=$(LC_ALL=C DEBIAN_FRONTEND=noninteractive apt-get -qq "$@" 2>&1 </dev/null); do
        if [[ $messages != *"Could not get lock"* && $messages != *"Unable to lock"* ]] || [ "$SECONDS" -ge "$deadline" ]; then
            printf '%s\n' "$messages" >&2
            return 1
        fi
        [ "$waiting" = yes ] || echo "another apt is running: waiting for it, at most $((lock_wait_s / 60)) minutes" >&2
        waiting=yes
        sleep 1
    done
}

# debian_mirror: where this machine's apt has Debian from; nothing where it does not say
debian_mirror() {
    ! command -v apt-get >/dev/null ||
        apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Label: Debian' | awk 'NR == 1'
}
