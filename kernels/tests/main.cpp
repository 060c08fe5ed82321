// Runs the tests of the kernels, without Python: laws that hold for every input, and the circle definition on small
// integer sets.
#include <cstdio>
#include <cstdlib>

#include "expect.hpp"

int main() {
    int passed = 0, failed = 0;
    for (const auto& [name, run] : all_tests()) {
        const long before = failures;
        run();
        const bool is_good = failures == before;
        ++(is_good ? passed : failed);
        std::printf("%s %s\n", is_good ? "ok    " : "FAILED", name);
    }
    std::printf("%ld checks\n%d passed, %d failed\n", checks, passed, failed);
    return failed == 0 && passed > 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
