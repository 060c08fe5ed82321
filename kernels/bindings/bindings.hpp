// What all bindings share: arrays from Python and for it, and checks. Only the files in this folder know Python. They
// check shapes; values are the business of the callers in tensor_stereo/ops.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <stdexcept>

#include "tensor_stereo/buffer.hpp"

namespace bindings {

namespace nb = nanobind;
namespace ts = tensor_stereo;

template <class T, class... Shape>
using Input = nb::ndarray<const T, Shape..., nb::c_contig, nb::device::cpu>;
using Points = Input<double, nb::shape<-1, 2>>;
using RowsOfTwo = Input<std::int64_t, nb::shape<-1, 2>>;
using Integers = Input<std::int64_t, nb::ndim<1>>;
using Doubles = Input<double, nb::ndim<1>>;
template <class T>
using Output = nb::ndarray<nb::numpy, T, nb::ndim<1>>;

void bind_graphs(nb::module_& module);
void bind_soft(nb::module_& module);
void bind_matches(nb::module_& module);
void bind_images(nb::module_& module);
void bind_learned(nb::module_& module);

// What frees an array that NumPy holds.
nb::capsule owner_of(void* data);

template <class T>
Output<T> give(ts::Buffer<T> values, std::size_t size) {
    T* const data = values.release();
    return Output<T>(data, {size}, owner_of(data));
}

template <std::size_t kColumns, class T>
auto give_rows(ts::Buffer<T> values, std::size_t rows) {
    T* const data = values.release();
    return nb::ndarray<nb::numpy, T, nb::shape<-1, kColumns>>(data, {rows, kColumns}, owner_of(data));
}

inline void check(bool condition, const char* message) {
    if (!condition) throw std::invalid_argument(message);
}

// That offsets rise from 0 to a total.
void check_offsets(const Integers& ptr, std::int64_t total, const char* message);

// That numbers are rows of points.
void check_index(const Integers& index, std::int64_t num_points,
                 const char* message = "index must name rows of points");

}  // namespace bindings
