// The nearest points, found in a tree of boxes: eight points in a leaf, eight leaves in a node, eight nodes in the next.
//
// neighbours.py compiles this file where there is a C++ compiler and calls it. The points are ordered as in a k-d tree,
// each part split across its longest side; a leaf is eight points of that order. Eight queries that follow one another
// walk down the tree together. All of it is exact, in float64.

#include "lanes.h"

extern "C" {

// The tree of n points. Level 0 has one node for eight leaves, level 1 one for eight of these, and the last has one.
struct Tree {
    const double* points;  // [n, 3]
    int64_t* order;        // [n] 0 to n - 1; then as the leaves hold them
    int64_t count, levels;
    int64_t starts[16];  // of each level among the boxes
    double* leaves;      // [ceil(n / 8), 3, 8]; infinite after the last point
    double* boxes;       // [nodes, 6, 8] smallest and largest coordinates of the children of each node
};

// Queries by blocks of eight.
struct Search {
    Tree tree;
    const double* queries;  // [m, 3]; null where the queries are the points themselves
    const int64_t* leaves;  // [m] a leaf near each query, which is looked at first
    int64_t count, wanted;  // m; at most 32
    int32_t* found;         // [m, wanted] indices of points, the nearest first; points by their own index. -1 for none
};

}  // extern "C"

namespace {

constexpr int MOST = 32;  // neighbours
constexpr double NOWHERE = std::numeric_limits<double>::infinity();

inline Wide wide(double value) { return Wide{} + value; }

inline Wide lower(Wide a, Wide b) { return a < b ? a : b; }

inline Wide higher(Wide a, Wide b) { return a > b ? a : b; }

inline Wide read(const double* from) {
    Wide out;
    std::memcpy(&out, from, sizeof(Wide));
    return out;
}

inline double least(Wide x) {
    double low = x[0];
    for (int lane = 1; lane < LANES; ++lane) low = std::min(low, x[lane]);
    return low;
}

inline double greatest(Wide x) {
    double high = x[0];
    for (int lane = 1; lane < LANES; ++lane) high = std::max(high, x[lane]);
    return high;
}

// Orders points as in a k-d tree. A node of the lowest level that holds them has children of up to ``most`` points, all
// but the last of them full.
void split(const double* points, int64_t* order, int64_t count, int64_t most) {
    if (count <= LANES) return;
    while (count <= most) most /= LANES;
    double low[3] = {NOWHERE, NOWHERE, NOWHERE}, high[3] = {-NOWHERE, -NOWHERE, -NOWHERE};
    for (int64_t i = 0; i < count; ++i)
        for (int axis = 0; axis < 3; ++axis) {
            const double value = points[3 * order[i] + axis];
            low[axis] = std::min(low[axis], value), high[axis] = std::max(high[axis], value);
        }
    int axis = 0;
    for (int other = 1; other < 3; ++other)
        if (high[other] - low[other] > high[axis] - low[axis]) axis = other;
    const int64_t left = (count + most - 1) / most / 2 * most;
    std::nth_element(order, order + left, order + count, [&](int64_t a, int64_t b) {
        return points[3 * a + axis] < points[3 * b + axis];
    });
    split(points, order, left, most);
    split(points, order + left, count - left, most);
}

struct Step {
    double distance;  // squared, from the queries to the box
    int64_t node;
    int level;  // -1 for a leaf
};

// Up to eight queries and the nearest points found so far.
struct Block {
    const Tree& tree;
    const int wanted;
    int size = 0;
    double at[LANES][3];
    int64_t own[LANES];  // a point that does not count, -1 for none
    double distances[LANES][MOST];
    int32_t indices[LANES][MOST];
    Wide low[3], high[3];  // of the queries

    Block(const Tree& tree, int wanted) : tree(tree), wanted(wanted) {}

    void add(const double* query, int64_t point) {
        for (int axis = 0; axis < 3; ++axis) {
            at[size][axis] = query[axis];
            low[axis] = size ? lower(low[axis], wide(query[axis])) : wide(query[axis]);
            high[axis] = size ? higher(high[axis], wide(query[axis])) : wide(query[axis]);
        }
        own[size] = point;
        std::fill(distances[size], distances[size] + wanted, NOWHERE);
        std::fill(indices[size], indices[size] + wanted, -1);
        ++size;
    }

    double farthest() const {
        double result = 0.0;
        for (int query = 0; query < size; ++query) result = std::max(result, distances[query][wanted - 1]);
        return result;
    }

    void look_at(int64_t leaf) {
        const double* from = tree.leaves + 3 * LANES * leaf;
        const Wide x = read(from), y = read(from + LANES), z = read(from + 2 * LANES);
        for (int query = 0; query < size; ++query) {
            const Wide dx = x - at[query][0], dy = y - at[query][1], dz = z - at[query][2];
            const Wide squared = dx * dx + dy * dy + dz * dz;
            const auto near = squared < wide(distances[query][wanted - 1]);
            int64_t any = 0;
            for (int lane = 0; lane < LANES; ++lane) any |= near[lane];
            if (!any) continue;
            for (int lane = 0; lane < LANES; ++lane)
                if (near[lane]) keep(query, squared[lane], tree.order[leaf * LANES + lane]);
        }
    }

    void keep(int query, double distance, int64_t point) {
        double* kept = distances[query];
        int place = wanted - 1;
        if (!(distance < kept[place]) || point == own[query]) return;
        for (; place > 0 && distance < kept[place - 1]; --place) {
            kept[place] = kept[place - 1];
            indices[query][place] = indices[query][place - 1];
        }
        kept[place] = distance;
        indices[query][place] = static_cast<int32_t>(point);
    }

    // Looks at all leaves that may hold nearer points, except those of ``done``.
    void walk(const int64_t* done, int done_count) {
        Step stack[16 * LANES];
        int depth = 0;
        stack[depth++] = {0.0, 0, static_cast<int>(tree.levels) - 1};
        double bound = farthest();
        while (depth > 0) {
            const Step step = stack[--depth];
            if (!(step.distance < bound)) continue;
            if (step.level < 0) {
                if (std::find(done, done + done_count, step.node) == done + done_count) {
                    look_at(step.node);
                    bound = farthest();
                }
                continue;
            }
            const double* box = tree.boxes + 6 * LANES * (tree.starts[step.level] + step.node);
            Wide squared = {};
            for (int axis = 0; axis < 3; ++axis) {
                const Wide before = read(box + LANES * axis) - high[axis];
                const Wide after = low[axis] - read(box + LANES * (axis + 3));
                const Wide apart = higher(higher(before, after), Wide{});
                squared += apart * apart;
            }
            const int first = depth;  // the nearest child is put on top
            for (int lane = 0; lane < LANES; ++lane) {
                if (!(squared[lane] < bound)) continue;
                int place = depth++;
                for (; place > first && stack[place - 1].distance < squared[lane]; --place) stack[place] = stack[place - 1];
                stack[place] = {squared[lane], step.node * LANES + lane, step.level - 1};
            }
        }
    }
};

}  // namespace

extern "C" {

void pointsplat_order(const Tree* tree) {
    int64_t most = LANES;
    while (LANES * most < tree->count) most *= LANES;
    split(tree->points, tree->order, tree->count, most);
}

void pointsplat_leaves(const Tree* given, int64_t* next) {
    const Tree& tree = *given;
    each_range(next, (tree.count + LANES - 1) / LANES, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t leaf = first; leaf < last; ++leaf)
            for (int lane = 0; lane < LANES; ++lane) {
                const int64_t at = leaf * LANES + lane;
                for (int axis = 0; axis < 3; ++axis)
                    tree.leaves[(3 * leaf + axis) * LANES + lane] =
                        at < tree.count ? tree.points[3 * tree.order[at] + axis] : NOWHERE;
            }
    });
}

// The boxes of a level, when those of the level below are there.
void pointsplat_boxes(const Tree* given, int64_t level, int64_t* next) {
    const Tree& tree = *given;
    const int64_t leaves = (tree.count + LANES - 1) / LANES;
    int64_t children = leaves;
    for (int64_t l = 0; l < level; ++l) children = (children + LANES - 1) / LANES;
    each_range(next, (children + LANES - 1) / LANES, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t node = first; node < last; ++node) {
            double* box = tree.boxes + 6 * LANES * (tree.starts[level] + node);
            for (int lane = 0; lane < LANES; ++lane) {
                const int64_t child = node * LANES + lane;
                for (int axis = 0; axis < 3; ++axis) {
                    double low = NOWHERE, high = -NOWHERE;
                    if (child < children && level == 0) {
                        const double* leaf = tree.leaves + (3 * child + axis) * LANES;
                        for (int64_t i = 0; i < std::min<int64_t>(LANES, tree.count - child * LANES); ++i)
                            low = std::min(low, leaf[i]), high = std::max(high, leaf[i]);
                    } else if (child < children) {
                        const double* below = tree.boxes + 6 * LANES * (tree.starts[level - 1] + child);
                        low = least(read(below + LANES * axis)), high = greatest(read(below + LANES * (axis + 3)));
                    }
                    box[LANES * axis + lane] = low, box[LANES * (axis + 3) + lane] = high;
                }
            }
        }
    });
}

void pointsplat_nearest(const Search* given, int64_t* next) {
    const Search& search = *given;
    const Tree& tree = search.tree;
    const int wanted = static_cast<int>(search.wanted);
    each_range(next, (search.count + LANES - 1) / LANES, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t at = first; at < last; ++at) {
            Block block(tree, wanted);
            int64_t done[LANES], done_count = 0, rows[LANES];
            for (int64_t query = at * LANES; query < std::min((at + 1) * LANES, search.count); ++query) {
                const int64_t row = search.queries ? query : tree.order[query];
                const int64_t leaf = search.queries ? search.leaves[query] : at;
                rows[block.size] = row;
                block.add((search.queries ? search.queries : tree.points) + 3 * row, search.queries ? -1 : row);
                if (std::find(done, done + done_count, leaf) == done + done_count) done[done_count++] = leaf;
            }
            for (int64_t i = 0; i < done_count; ++i) block.look_at(done[i]);
            block.walk(done, static_cast<int>(done_count));
            for (int query = 0; query < block.size; ++query)
                std::copy(block.indices[query], block.indices[query] + wanted, search.found + rows[query] * wanted);
        }
    });
}

}  // extern "C"
