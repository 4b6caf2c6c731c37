// Which grains and walls may touch before neighbours are found again, in an order that several threads can sweep.
//
// Detection uses one grid per size class (radii within a factor of two), so that the cost per grain does not depend on d_max/d_min.
// The list holds every pair nearer than `skin`; it stays valid as long as the motion of grains relative to their surroundings,
// not their motion through space, cannot have brought an unlisted pair nearer than the distance asked for.
//
// Order: grains are sorted by cells, slowest along the longest side of the scene, and cut into blocks of `block_size`. A pair
// belongs to a block; blocks of one colour touch no common block, so they may be swept at the same time; within a block
// consecutive pairs share no grain, so that the processor need not wait for the result of the last one. The order depends on
// the grains only, never on the number of threads: results are the same bit for bit.
#pragma once

#include "contact.hpp"
#include "grains.hpp"

#include <span>

namespace quicksand {

template <int dim>
struct Pair {
  int i, j;           // grains; i has the lower id
  int shift;          // which periodic image of j: index into Neighbours::shifts
  Impulse<dim> p;     // of the last step: the warm start of the next
};

template <int dim>
struct WallPair {
  int wall;
  int fixed;  // the grain fixed to the wall that j may touch; -1: the wall's plane or segment itself
  int j;
  int shift;
  Impulse<dim> p;
};

struct Block {
  int begin, end;  // pairs
};

template <int dim>
class Neighbours {
 public:
  static constexpr int block_size = 128;  // grains; 32 to 512 differ by less than 10 % in 2D

  std::vector<Pair<dim>> pairs;
  std::vector<WallPair<dim>> wall_pairs;
  std::vector<Block> blocks;        // sorted by colour
  std::vector<int> colours;         // blocks[colours[c]] ... blocks[colours[c+1] - 1] have colour c
  std::vector<Vec<dim>> shifts;     // periodic shifts [m]
  long found = 0;                   // how often find() has run

  // Sorts the grains, lists every pair with a gap below `skin` [m], keeps the impulses of pairs already known.
  void find(Grains<dim>& grains, std::vector<Wall<dim>>& walls, const Box<dim>& box, double skin, int threads);

  // True when no unlisted pair can be nearer than `reach` [m] now: a bound, never an estimate.
  bool valid(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, double reach, int threads);

  void forget() { skin_ = -1.0; }  // grains or walls were added or moved from outside

 private:
  void sort(Grains<dim>& grains, const Box<dim>& box);
  void list(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, const Box<dim>& box, int threads);
  void arrange(int grains, int threads);

  struct Found {
    std::vector<Pair<dim>> pairs;
    std::vector<WallPair<dim>> wall_pairs;
  };
  double skin_ = -1.0;                  // [m]; negative: nothing listed yet
  std::vector<Vec<dim>> x_found_;       // centres when neighbours were found [m]
  std::vector<int> new_of_old_;         // permutation of the last sort
  std::vector<Found> found_in_block_;   // scratch
  // Cells of the validity bound; the grains of cell c are cell_start_[c] ... cell_start_[c+1] - 1.
  std::array<int, dim> cells_{};
  std::array<bool, dim> around_{};      // periodic axes
  std::vector<int> cell_start_;
  std::vector<Vec<dim>> cell_mean_;     // mean way of a cell's grains [m]
  std::vector<double> cell_spread_;     // largest way of a grain relative to that mean [m]
  std::vector<double> cell_wall_gap_;   // [wall][cell]: smallest gap of a grain not listed with the wall [m]
};

// Calls visit(i, j, shift code) for each pair with |x_j - x_i| < factor (r_i + r_j) + skin, once, i of the smaller size class.
// Needs periods of at least two reaches.
template <int dim>
class CloseGrains {
 public:
  CloseGrains(std::span<const Vec<dim>> x, std::span<const double> r, const Box<dim>& box, double factor, double skin);
  template <class Visit>
  void visit(int i, Visit&& visit) const;

 private:
  struct Level {
    double r_max = 0.0;
    Vec<dim> low, inv_size;
    std::array<int, dim> cells{};
    std::vector<int> start, member;
    std::vector<int> grains;
  };
  int cell_of(const Level& level, const Vec<dim>& x) const;
  std::span<const Vec<dim>> x_;
  std::span<const double> r_;
  const Box<dim>& box_;
  double factor_, skin_;
  std::vector<std::uint8_t> level_of_;
  std::vector<Level> levels_;
};

template <int dim>
template <class Visit>
void CloseGrains<dim>::visit(int i, Visit&& visit) const {
  const Vec<dim> x = x_[i];
  for (std::size_t l = level_of_[i]; l < levels_.size(); ++l) {
    const Level& level = levels_[l];
    if (level.grains.empty()) continue;
    const double reach = factor_ * (r_[i] + level.r_max) + skin_;
    std::array<int, 3> lo{}, hi{};
    for (int k = 0; k < dim; ++k) {
      lo[k] = static_cast<int>(std::floor((x[k] - reach - level.low[k]) * level.inv_size[k]));
      hi[k] = static_cast<int>(std::floor((x[k] + reach - level.low[k]) * level.inv_size[k]));
      const bool around = box_.period[k] > 0;
      if (!around) lo[k] = std::max(lo[k], 0), hi[k] = std::min(hi[k], level.cells[k] - 1);
      if (around && hi[k] - lo[k] + 1 >= level.cells[k]) lo[k] = 0, hi[k] = level.cells[k] - 1;
    }
    auto wrapped = [&](int c, int k) {
      return c < 0 ? c + level.cells[k] : (c >= level.cells[k] ? c - level.cells[k] : c);
    };
    for (int c2 = lo[2]; c2 <= hi[2]; ++c2)
      for (int c1 = lo[1]; c1 <= hi[1]; ++c1)
        for (int c0 = lo[0]; c0 <= hi[0]; ++c0) {
          int cell = wrapped(c0, 0);
          if constexpr (dim == 3) cell = wrapped(c2, 2) + level.cells[2] * (wrapped(c1, 1) + level.cells[1] * cell);
          if constexpr (dim == 2) cell = wrapped(c1, 1) + level.cells[1] * cell;
          for (int m = level.start[cell]; m < level.start[cell + 1]; ++m) {
            const int j = level.member[m];
            if (l == level_of_[i] && j <= i) continue;
            Vec<dim> ab = x_[j] - x;
            int code = 0;
            for (int k = 0; k < dim; ++k) {
              int turns = 1;  // 0: image one period up, 1: none, 2: one period down
              if (box_.period[k] > 0) {
                if (ab[k] < -0.5 * box_.period[k]) ab[k] += box_.period[k], turns = 0;
                else if (ab[k] > 0.5 * box_.period[k]) ab[k] -= box_.period[k], turns = 2;
              }
              code = 3 * code + turns;
            }
            const double near = factor_ * (r_[i] + r_[j]) + skin_;
            if (ab.squaredNorm() < near * near) visit(i, j, code);
          }
        }
  }
}

// The shift that a code of CloseGrains stands for [m], and the code of the way back.
template <int dim>
Vec<dim> periodic_shift(const Box<dim>& box, int code) {
  Vec<dim> shift;
  for (int k = dim - 1; k >= 0; --k, code /= 3) shift[k] = (1 - code % 3) * box.period[k];
  return shift;
}
template <int dim>
constexpr int shift_back(int code) {
  return (dim == 2 ? 8 : 26) - code;
}

}  // namespace quicksand
