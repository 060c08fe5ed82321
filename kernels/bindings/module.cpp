// The Python module tensor_stereo._kernels.
#include "bindings.hpp"

NB_MODULE(_kernels, module) {
    bindings::bind_graphs(module);
    bindings::bind_soft(module);
    bindings::bind_matches(module);
    bindings::bind_images(module);
    bindings::bind_learned(module);
}
