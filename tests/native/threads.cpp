// OpenMP as far as the kernels use it, on plain threads: for ThreadSanitizer, which does not see how libgomp synchronises
// and would report races that are none. Every region starts its threads and joins them; a loop's chunks come from one
// atomic counter. GCC's names and types (libgomp/libgomp_g.h).
#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace {

struct Team {
    int size;
    std::atomic<long> next{0};
    long end = 0, chunk = 1;
    std::mutex mutex;
    std::condition_variable all_here;
    int arrived = 0, loops = 0;
};

thread_local Team *team;
thread_local int number;

void run(void (*body)(void *), void *data, Team &t) {
    std::vector<std::thread> others;
    auto work = [&](int i) {
        team = &t, number = i;
        body(data);
        team = nullptr;
    };
    for (int i = 1; i < t.size; i++) others.emplace_back(work, i);
    work(0);
    for (std::thread &other : others) other.join();
}

// The last thread to arrive opens the loop, once for all.
void open(long start, long end, long chunk) {
    std::unique_lock<std::mutex> lock(team->mutex);
    const int mine = team->loops;
    if (++team->arrived == team->size) {
        team->next = start, team->end = end, team->chunk = chunk, team->arrived = 0, team->loops++;
        team->all_here.notify_all();
    } else {
        team->all_here.wait(lock, [&] { return team->loops != mine; });
    }
}

}  // namespace

extern "C" {

int omp_get_num_threads() { return team ? team->size : 1; }
int omp_get_thread_num() { return team ? number : 0; }

bool GOMP_loop_nonmonotonic_dynamic_next(long *from, long *to) {
    *from = team->next.fetch_add(team->chunk);
    *to = *from + team->chunk < team->end ? *from + team->chunk : team->end;
    return *from < team->end;
}
bool GOMP_loop_nonmonotonic_dynamic_start(long start, long end, long step, long chunk, long *from, long *to) {
    open(start, end, chunk * step);
    return GOMP_loop_nonmonotonic_dynamic_next(from, to);
}
void GOMP_loop_end_nowait() {}
void GOMP_loop_end() {}

void GOMP_parallel(void (*body)(void *), void *data, unsigned threads, unsigned) {
    Team t;
    t.size = (int)threads;
    run(body, data, t);
}
void GOMP_parallel_loop_nonmonotonic_dynamic(void (*body)(void *), void *data, unsigned threads, long start, long end, long step,
                                             long chunk, unsigned) {
    Team t;
    t.size = (int)threads, t.next = start, t.end = end, t.chunk = chunk * step;
    run(body, data, t);
}
}
