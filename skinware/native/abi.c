/* The number of what this library offers to Python: the loader takes a library of its own number only. */

__attribute__((visibility("default"))) int skinware_native_abi(void) {
    return 1;
}
