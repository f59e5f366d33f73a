/* Which places of the data path were reached: GCC and clang call this at each, with -fsanitize-coverage=trace-pc. */
#include <stdint.h>

enum { PLACES = 1 << 16 };

__attribute__((visibility("default"))) uint8_t reached[PLACES];

__attribute__((visibility("default"))) void __sanitizer_cov_trace_pc(void)
{
    reached[(uintptr_t)__builtin_return_address(0) % PLACES] = 1;
}
