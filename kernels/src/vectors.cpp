#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

bool has_vectors(Vectors vectors) {
#if defined(__x86_64__) && defined(__GNUC__)
    if (vectors == Vectors::kAvx2) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (vectors == Vectors::kAvx512) {
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
               __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw");
    }
#endif
    return vectors == Vectors::kBest || vectors == Vectors::kBaseline;
}

}  // namespace tensor_stereo
