// TEST adds a test to the program, EXPECT counts what does not hold.
#pragma once

#include <cstdio>
#include <vector>

struct Test {
    const char* name;
    void (*run)();
};

// A function's static is there before the first test of any file is added.
inline std::vector<Test>& all_tests() {
    static std::vector<Test> tests;
    return tests;
}

inline bool add_test(const char* name, void (*run)()) {
    all_tests().push_back({name, run});
    return true;
}

inline long checks = 0, failures = 0;

#define TEST(name)                                                              \
    static void name();                                                         \
    [[maybe_unused]] static const bool name##_is_added = add_test(#name, name); \
    static void name()

#define EXPECT(condition)                                                        \
    do {                                                                         \
        ++checks;                                                                \
        if (!(condition)) {                                                      \
            std::fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition); \
            ++failures;                                                          \
        }                                                                        \
    } while (false)
