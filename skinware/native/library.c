/* The number of what this library offers to Python: the loader takes a library of its own number only. */
#include <stdint.h>

__attribute__((visibility("default"))) uint32_t skinware_native_abi(void) {
    return 1;
}
