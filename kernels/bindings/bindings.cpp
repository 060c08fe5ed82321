#include "bindings.hpp"

namespace bindings {

nb::capsule owner_of(void* data) {
    return nb::capsule(data, [](void* memory) noexcept { ts::Free()(memory); });
}

void check_offsets(const Integers& ptr, std::int64_t total, const char* message) {
    const std::int64_t* const offset = ptr.data();
    const std::size_t size = ptr.shape(0);
    check(size >= 1 && offset[0] == 0 && offset[size - 1] == total, message);
    for (std::size_t k = 1; k < size; ++k) check(offset[k - 1] <= offset[k], message);
}

void check_index(const Integers& index, std::int64_t num_points, const char* message) {
    const std::int64_t* const row = index.data();
    for (std::size_t k = 0; k < index.shape(0); ++k) check(row[k] >= 0 && row[k] < num_points, message);
}

}  // namespace bindings
