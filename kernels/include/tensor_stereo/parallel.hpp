// Runs independent items on a few threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace tensor_stereo {

// Calls make_worker() once per thread and what it returns with (begin, end) ranges of up to `grain` items, until all
// `count` items are done. The split between threads is open, so workers must not depend on it. The first exception is
// thrown again here.
template <class MakeWorker>
void parallel_for(std::int64_t count, std::int64_t grain, int num_threads, const MakeWorker& make_worker) {
    std::atomic<std::int64_t> position{0};
    std::exception_ptr error;
    std::mutex error_lock;
    auto run = [&] {
        try {
            auto worker = make_worker();
            while (true) {
                const std::int64_t begin = position.fetch_add(grain);
                if (begin >= count) return;
                worker(begin, std::min(begin + grain, count));
            }
        } catch (...) {
            const std::lock_guard guard(error_lock);
            if (!error) error = std::current_exception();
            position = count;
        }
    };
    const auto helpers = std::min<std::int64_t>(num_threads, (count + grain - 1) / grain) - 1;
    std::vector<std::thread> threads;
    try {
        for (std::int64_t k = 0; k < helpers; ++k) threads.emplace_back(run);
    } catch (const std::system_error&) {  // no more threads to be had: those that run do the work
    }
    run();
    for (auto& thread : threads) thread.join();
    if (error) std::rethrow_exception(error);
}

}  // namespace tensor_stereo
