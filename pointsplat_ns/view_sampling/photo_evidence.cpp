// Evidence of SH for photo places, for float32 on a CPU; explained_energy in traces.py is the same in torch.
//
// The squares of the basis functions of one degree have the same sum in all directions (Unsold's theorem), so that the
// energy that a direction explains needs no division.

#include "../rendering/compiled/harmonics.h"

extern "C" {

struct PhotoEvidence {
    const double* places;  // [P, 3]
    int64_t count;         // P
    const double* means;   // [blocks, 3, LANES] of Gaussians
    const float* sh;       // [blocks, (degree + 1)^2 - 1, 3, LANES], of length 1; 0 for lanes without Gaussian
    int64_t blocks, degree;
    double factor;         // of the sum over Gaussians
    float* evidence;       // [P]
};

}  // extern "C"

namespace {

template <int DEGREE>
void find_evidence(const PhotoEvidence& task, int64_t* next) {
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    for (int64_t place; (place = __atomic_fetch_add(next, 1, __ATOMIC_RELAXED)) < task.count;) {
        double total = 0.0;
        for (int64_t block = 0; block < task.blocks; ++block) {
            Lane unit[3], basis[USED], along[3] = {ZERO, ZERO, ZERO};
            for (int d = 0; d < 3; ++d) {
                Wide mean;
                std::memcpy(&mean, task.means + (block * 3 + d) * LANES, sizeof(mean));
                unit[d] = narrow(mean - task.places[3 * place + d]);
            }
            normalise(unit);
            basis_of<DEGREE>(unit, basis);
            const float* sh = task.sh + block * (USED - 1) * 3 * LANES;
            for (int k = 1; k < USED; ++k)
                for (int c = 0; c < 3; ++c, sh += LANES) {
                    Lane value;
                    std::memcpy(&value, sh, sizeof(value));
                    along[c] += value * basis[k];
                }
            total += sum(dot(along, along));
        }
        task.evidence[place] = static_cast<float>(total * task.factor);
    }
}

}  // namespace

extern "C" {

void pointsplat_photo_evidence(const PhotoEvidence* task, int64_t* next) {
    switch (task->degree) {
        case 1: return find_evidence<1>(*task, next);
        case 2: return find_evidence<2>(*task, next);
        case 3: return find_evidence<3>(*task, next);
    }
}

}  // extern "C"
