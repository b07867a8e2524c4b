// Nearest neighbours of points: exact, in float64, on a CPU.
//
// neighbours.py calls this file where it was built; box_tree.py does the same in torch. The tree halves the points, across
// the widest axis of their box, down to leaves of eight points, which are one vector. A query descends into the nearer
// half first, and skips boxes that are no nearer than the neighbours found so far. The order of the tree and each query
// depend on the points alone, so that the number of threads changes nothing.

#include <vector>

#include "lanes.h"

extern "C" {

// Points and their tree. Its nodes are in the order: node, nodes of its first half, nodes of its second half.
struct PointTree {
    const double* points;  // [N, 3]
    int64_t count;         // N
    int32_t* order;        // [N] points in the order of the leaves
    double* leaves;        // [leaves, 3, LANES] coordinates of the points; infinity after the last
    double* boxes;         // [2 leaves - 1, 6] lowest and highest corner of each node
};

struct NearestPoints {
    PointTree tree;
    const double* queries;   // [M, 3]
    int64_t queried, wanted; // M, and number of neighbours, at most MOST_NEAREST and at most N
    double* distances;       // [M, wanted], nearest first; or null
    int32_t* indices;        // [M, wanted]
};

}  // extern "C"

namespace {

constexpr int MOST_NEAREST = 16, DEEPEST = 64;
const Mask LANE_BITS = {1, 2, 4, 8, 16, 32, 64, 128};

struct Point {
    double at[3];
    int32_t index;
};

// Some consecutive leaves, and the node of the tree that has them.
struct Part {
    int64_t node, first, last;  // leaves from ``first`` on, before ``last``

    int64_t middle() const { return first + (last - first) / 2; }
    Part left() const { return {node + 1, first, middle()}; }
    Part right() const { return {node + 2 * (middle() - first), middle(), last}; }
};

void build(const PointTree& tree, std::vector<Point>& points, Part part) {
    const int64_t from = part.first * LANES, to = std::min<int64_t>(part.last * LANES, tree.count);
    double* low = tree.boxes + 6 * part.node;
    double* high = low + 3;
    std::copy(points[from].at, points[from].at + 3, low);
    std::copy(low, low + 3, high);
    for (int64_t i = from + 1; i < to; ++i)
        for (int d = 0; d < 3; ++d) {
            low[d] = std::min(low[d], points[i].at[d]);
            high[d] = std::max(high[d], points[i].at[d]);
        }
    if (part.last - part.first == 1) {
        for (int lane = 0; lane < LANES; ++lane)
            for (int d = 0; d < 3; ++d)
                tree.leaves[(part.first * 3 + d) * LANES + lane] =
                    from + lane < to ? points[from + lane].at[d] : std::numeric_limits<double>::infinity();
        for (int64_t i = from; i < to; ++i) tree.order[i] = points[i].index;
        return;
    }
    int widest = 0;
    for (int d = 1; d < 3; ++d)
        if (high[d] - low[d] > high[widest] - low[widest]) widest = d;
    const auto start = points.begin();
    std::nth_element(start + from, start + part.middle() * LANES, start + to,
                     [widest](const Point& a, const Point& b) { return a.at[widest] < b.at[widest]; });
    build(tree, points, part.left());
    build(tree, points, part.right());
}

// Squared distance of a query from a node's box; 0 inside.
inline double to_box(const PointTree& tree, const Part& part, const double* query) {
    const double* box = tree.boxes + 6 * part.node;
    double square = 0.0;
    for (int d = 0; d < 3; ++d) {
        const double apart = std::max(std::max(box[d] - query[d], query[d] - box[3 + d]), 0.0);
        square += apart * apart;
    }
    return square;
}

// Neighbours found so far, nearest first.
struct Nearest {
    int wanted;
    double squares[MOST_NEAREST];
    int64_t places[MOST_NEAREST];  // in the order of the tree

    explicit Nearest(int wanted) : wanted(wanted) {
        std::fill(squares, squares + wanted, std::numeric_limits<double>::infinity());
        std::fill(places, places + wanted, 0);
    }

    double farthest() const { return squares[wanted - 1]; }

    void add(double square, int64_t place) {
        int at = wanted - 1;
        for (; at > 0 && squares[at - 1] > square; --at) squares[at] = squares[at - 1], places[at] = places[at - 1];
        squares[at] = square, places[at] = place;
    }

    void add_leaf(const PointTree& tree, int64_t leaf, const double* query) {
        Wide square = {};
        for (int d = 0; d < 3; ++d) {
            Wide at;
            std::memcpy(&at, tree.leaves + (leaf * 3 + d) * LANES, sizeof(at));
            const Wide apart = at - query[d];
            square += apart * apart;
        }
        const Mask nearer = __builtin_convertvector(square < farthest(), Mask);
        each_bit(bits_of(nearer & LANE_BITS), [&](int lane) {
            if (square[lane] < farthest()) add(square[lane], leaf * LANES + lane);
        });
    }
};

void search(const PointTree& tree, const double* query, Nearest& found) {
    struct Later {
        Part part;
        double square;
    } later[DEEPEST];
    int count = 0;
    Part part = {0, 0, (tree.count + LANES - 1) / LANES};
    for (;;) {
        while (part.last - part.first > 1) {
            Part near = part.left(), far = part.right();
            double to_near = to_box(tree, near, query), to_far = to_box(tree, far, query);
            if (to_far < to_near) std::swap(near, far), std::swap(to_near, to_far);
            if (to_far < found.farthest()) later[count++] = {far, to_far};
            part = near;
        }
        found.add_leaf(tree, part.first, query);
        while (count && !(later[count - 1].square < found.farthest())) --count;
        if (!count) return;
        part = later[--count].part;
    }
}

}  // namespace

extern "C" {

int64_t pointsplat_most_nearest() { return MOST_NEAREST; }

// Writes order, leaves and boxes of at least one point.
void pointsplat_build_tree(const PointTree* tree) {
    std::vector<Point> points(tree->count);
    for (int64_t i = 0; i < tree->count; ++i) {
        const double* at = tree->points + 3 * i;
        points[i] = {{at[0], at[1], at[2]}, static_cast<int32_t>(i)};
    }
    build(*tree, points, {0, 0, (tree->count + LANES - 1) / LANES});
}

// Writes distances and indices.
void pointsplat_nearest(const NearestPoints* task, int64_t* next) {
    const int64_t wanted = task->wanted;
    each_range(next, task->queried, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            Nearest found(static_cast<int>(wanted));
            search(task->tree, task->queries + 3 * i, found);
            for (int64_t j = 0; j < wanted; ++j) {
                task->indices[i * wanted + j] = task->tree.order[found.places[j]];
                if (task->distances) task->distances[i * wanted + j] = std::sqrt(found.squares[j]);
            }
        }
    });
}

}  // extern "C"
