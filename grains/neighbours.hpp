// Which grains and walls may touch before neighbours are found again, in an order that several threads can sweep.
//
// Detection uses one grid per size class (radii within a factor of two), so that the cost per grain does not depend on d_max/d_min.
// Walls are looked for in the cells that the order comes from: the cost per grain does not depend on how many facets there are.
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
  int fixed;  // the grain fixed to the wall that j may touch; -1: the wall's plane or facet itself
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

  // True when no unlisted pair can be nearer than `reach` [m] now, nor after all have moved for `h` [s] with their present velocity:
  // a bound, never an estimate.
  bool valid(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, double reach, double h, int threads);

  // Some grains have left, the others closed up in their order: what is known of these stays. -1 in the place of a grain that left.
  void remove(std::span<const int> new_of_old);

  template <class Archive>
  void visit_state(Archive&& archive);  // state.cpp

  void forget() { skin_ = -1.0; }  // grains or walls were added or moved from outside

 private:
  struct Grid {  // cells, numbered with the first of `axes` slowest
    Vec<dim> low, inv_size;
    std::array<int, dim> cells, axes;
  };
  Grid sort(Grains<dim>& grains, const Box<dim>& box);
  void list(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, const Box<dim>& box, const Grid& grid, int threads);
  void measure_facets(const std::vector<Wall<dim>>& walls, const Box<dim>& box, const Grid& grid, double r_max);
  template <class Visit>
  void each_cell_near(const Wall<dim>& facet, const Box<dim>& box, const Grid& grid, double margin, Visit&& visit) const;
  template <class Visit>
  void each_cell_beside(int cell, Visit&& visit) const;
  void arrange(int grains, int threads);
  bool within(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, double reach, double h, int threads);

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
  std::vector<double> cell_wall_gap_;   // [plane][cell]: smallest gap of a grain not listed with the plane [m]
  std::vector<double> cell_facet_gap_;  // no grain of the cell has a smaller gap to a facet it is not listed with [m]
};

// Calls visit(i, j, shift code) for each pair with |x_j - x_i| < factor (r_i + r_j) + skin, once, i of the smaller size class.
// Positions must be wrapped into the box, and periods longer than two reaches.
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
    std::vector<int> start, member;  // grains by cell, the last axis fastest
    std::vector<int> grains;
  };
  std::array<int, dim> own_cell(const Level& level, const Vec<dim>& x) const;
  std::span<const Vec<dim>> x_;
  std::span<const double> r_;
  const Box<dim>& box_;
  double factor_, skin_;
  std::vector<std::uint8_t> level_of_;
  std::vector<int> place_;  // of each grain in `member` of its level
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
    std::array<int, dim> lo, hi;  // cells to look at; beyond the ends along periodic axes: images
    for (int k = 0; k < dim; ++k) {
      lo[k] = static_cast<int>(std::floor((x[k] - reach - level.low[k]) * level.inv_size[k]));
      hi[k] = static_cast<int>(std::floor((x[k] + reach - level.low[k]) * level.inv_size[k]));
      if (box_.period[k] == 0) lo[k] = std::max(lo[k], 0), hi[k] = std::min(hi[k], level.cells[k] - 1);
    }
    // Within a size class each pair is met once: cells after the grain's own, in the order of `member`, and the rest of its own.
    const bool same = l == level_of_[i];
    std::array<int, dim> from = lo;
    if (same) from = own_cell(level, x);
    const double own = factor_ * r_[i] + skin_;
    auto row = [&](int begin, int end, const Vec<dim>& at, int code) {
      for (int m = begin; m < end; ++m) {
        const int j = level.member[m];
        const double near = own + factor_ * r_[j];
        if ((x_[j] - at).squaredNorm() < near * near) visit(i, j, code);
      }
    };
    // Cells that follow each other along the last axis hold grains that follow each other in `member`.
    auto rows = [&](int cell, bool own_row, Vec<dim> at, int code) {
      constexpr int k = dim - 1;
      const int n = level.cells[k], around = box_.period[k] > 0;
      for (int turn = -around; turn <= around; ++turn) {
        const int first = std::max((own_row ? from[k] : lo[k]) - turn * n, 0), last = std::min(hi[k] - turn * n, n - 1);
        if (first > last) continue;
        Vec<dim> seen = at;
        seen[k] -= turn * box_.period[k];
        const int begin = own_row && turn == 0 ? place_[i] + 1 : level.start[cell * n + first];
        row(begin, level.start[cell * n + last + 1], seen, 3 * code + 1 - turn);
      }
    };
    auto turned = [&](int c, int k) { return c < 0 ? -1 : (c >= level.cells[k] ? 1 : 0); };
    for (int c0 = from[0]; c0 <= hi[0]; ++c0) {
      Vec<dim> at = x;
      const int turn0 = turned(c0, 0);
      at[0] -= turn0 * box_.period[0];
      const int cell0 = c0 - turn0 * level.cells[0];
      const bool own0 = same && c0 == from[0];
      if constexpr (dim == 2) {
        rows(cell0, own0, at, 1 - turn0);
      } else {
        for (int c1 = own0 ? from[1] : lo[1]; c1 <= hi[1]; ++c1) {
          const int turn1 = turned(c1, 1);
          Vec<dim> seen = at;
          seen[1] -= turn1 * box_.period[1];
          rows(cell0 * level.cells[1] + c1 - turn1 * level.cells[1], own0 && c1 == from[1], seen,
               3 * (1 - turn0) + 1 - turn1);
        }
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
