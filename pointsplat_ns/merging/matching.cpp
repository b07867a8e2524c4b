// Which pairs go: the inner loops of matching.py, whose names are used here.
//
// matching.py calls this file where it was built. The results are those of torch, to
// the bit.

#include "lanes.h"

extern "C" {

struct Matching {
    const int32_t* near;  // [n, k]
    float* costs;         // [n, k]; then with each pair once, and infinite for pairs that cannot be
    int64_t count, neighbours, passes;
    int64_t* best;               // [n]
    int64_t* rows;               // [n] 0 to n - 1
    int64_t *firsts, *seconds;   // [n / 2] pairs
    float* prices;               // [n / 2]
    int64_t* found;              // [1] number of pairs
};

}  // extern "C"

namespace {

constexpr float NEVER = std::numeric_limits<float>::infinity();

// Ordered as costs that are not negative; ties by hashed numbers.
inline int64_t key_of(const Matching& m, int64_t slot) {
    int32_t bits;
    std::memcpy(&bits, m.costs + slot, sizeof(bits));
    return (static_cast<int64_t>(bits) << 32) | ((static_cast<uint64_t>(slot) * 2654435761u) & 0xFFFFFFFFu);
}

}  // namespace

extern "C" {

// Gives pairs whose second member has the larger index, or the smaller one, their one cost. The larger come first, as
// they read the costs of the smaller.
void pointsplat_symmetric(const Matching* task, int64_t larger, int64_t* next) {
    const Matching& m = *task;
    const int64_t k = m.neighbours;
    each_range(next, m.count, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i)
            for (int64_t slot = k * i; slot < k * (i + 1); ++slot) {
                const int64_t j = m.near[slot];
                if ((j > i) != (larger != 0)) continue;
                const int32_t* back = std::find(m.near + k * j, m.near + k * (j + 1), static_cast<int32_t>(i));
                float cost = m.costs[slot];
                if (back != m.near + k * (j + 1)) cost = j > i ? (cost + m.costs[back - m.near]) / 2 : NEVER;
                m.costs[slot] = j != i && cost == cost ? cost : NEVER;
            }
    });
}

void pointsplat_match(const Matching* task) {
    const Matching& m = *task;
    const int64_t k = m.neighbours, none = std::numeric_limits<int64_t>::max();
    int64_t left = m.count, found = 0;
    for (int64_t pass = 0; pass < m.passes && left > 0; ++pass) {
        std::fill(m.best, m.best + m.count, none);
        for (int64_t at = 0; at < left; ++at)
            for (int64_t slot = k * m.rows[at]; slot < k * (m.rows[at] + 1); ++slot) {
                if (m.costs[slot] == NEVER) continue;
                const int64_t key = key_of(m, slot);
                int64_t &mine = m.best[m.rows[at]], &theirs = m.best[m.near[slot]];
                mine = std::min(mine, key), theirs = std::min(theirs, key);
            }
        const int64_t before = found;
        for (int64_t at = 0; at < left; ++at)
            for (int64_t slot = k * m.rows[at]; slot < k * (m.rows[at] + 1); ++slot) {
                const int64_t i = m.rows[at], j = m.near[slot];
                if (m.costs[slot] == NEVER || m.best[i] != key_of(m, slot) || m.best[j] != m.best[i]) continue;
                m.firsts[found] = i, m.seconds[found] = j, m.prices[found++] = m.costs[slot];
            }
        if (found == before) break;
        for (int64_t pair = before; pair < found; ++pair) m.best[m.firsts[pair]] = m.best[m.seconds[pair]] = -1;  // taken
        int64_t kept = 0;
        for (int64_t at = 0; at < left; ++at) {
            const int64_t i = m.rows[at];
            bool any = false;
            for (int64_t slot = k * i; slot < k * (i + 1); ++slot) {
                if (m.best[i] == -1 || m.best[m.near[slot]] == -1) m.costs[slot] = NEVER;
                any |= m.costs[slot] != NEVER;
            }
            if (any) m.rows[kept++] = i;
        }
        left = kept;
    }
    *m.found = found;
}

}  // extern "C"
