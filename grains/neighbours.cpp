// Sorting, listing and arranging of neighbours: see neighbours.hpp for what and why.
#include "neighbours.hpp"

#include <numeric>

namespace quicksand {

namespace {

// Lowest and highest centre along each axis; the box where it is periodic.
template <int dim>
std::pair<Vec<dim>, Vec<dim>> extent(std::span<const Vec<dim>> x, const Box<dim>& box) {
  Vec<dim> low = Vec<dim>::Constant(0), high = low;
  if (!x.empty()) low = high = x[0];
  for (const Vec<dim>& p : x) low = low.cwiseMin(p), high = high.cwiseMax(p);
  for (int k = 0; k < dim; ++k)
    if (box.period[k] > 0) low[k] = -0.5 * box.period[k], high[k] = 0.5 * box.period[k];
  return {low, high};
}

// Cells no smaller than `size` that fill [low, high]; at most `most` of them, so that a grain far away costs no memory.
template <int dim>
std::array<int, dim> count_cells(const Vec<dim>& low, const Vec<dim>& high, double size, double most) {
  std::array<int, dim> cells{};
  for (;; size *= 1.5) {
    double total = 1;
    for (int k = 0; k < dim; ++k) total *= std::max(1.0, std::floor((high[k] - low[k]) / size));
    if (total > most) continue;
    for (int k = 0; k < dim; ++k) cells[k] = std::max(1, static_cast<int>((high[k] - low[k]) / size));
    return cells;
  }
}

template <int dim>
Vec<dim> inverse_size(const Vec<dim>& low, const Vec<dim>& high, const std::array<int, dim>& cells) {
  Vec<dim> inv;
  for (int k = 0; k < dim; ++k) inv[k] = high[k] > low[k] ? cells[k] / (high[k] - low[k]) : 0.0;
  return inv;
}

template <int dim>
std::array<int, dim> cell_at(const Vec<dim>& x, const Vec<dim>& low, const Vec<dim>& inv, const std::array<int, dim>& cells) {
  std::array<int, dim> c;
  for (int k = 0; k < dim; ++k) c[k] = std::clamp(static_cast<int>((x[k] - low[k]) * inv[k]), 0, cells[k] - 1);
  return c;
}

template <class T>
void permute(std::vector<T>& values, const std::vector<int>& order) {
  if (values.empty()) return;
  std::vector<T> sorted(values.size());
  for (std::size_t k = 0; k < order.size(); ++k) sorted[k] = values[order[k]];
  values.swap(sorted);
}

// Sorts the integers 0 ... keys.size() - 1 by key, stably; `start` gets where each key begins.
std::vector<int> sort_by_key(const std::vector<int>& keys, int n_keys, std::vector<int>& start) {
  start.assign(n_keys + 1, 0);
  for (int k : keys) ++start[k + 1];
  std::partial_sum(start.begin(), start.end(), start.begin());
  std::vector<int> next(start.begin(), start.end() - 1), order(keys.size());
  for (std::size_t i = 0; i < keys.size(); ++i) order[next[keys[i]]++] = static_cast<int>(i);
  return order;
}

// Impulses of the old list, to be found by the new numbers of their grains.
template <int dim, class OldPair>
class Known {
 public:
  template <class Key>
  Known(const std::vector<OldPair>& old, int grains, Key&& key) {
    std::vector<int> keys;
    for (const OldPair& pair : old)
      if (pair.p.n > 0) entries_.push_back(pair), keys.push_back(key(entries_.back()));
    order_ = sort_by_key(keys, grains, start_);
  }
  template <class Same>
  Impulse<dim> find(int key, Same&& same) const {
    for (int k = start_[key]; k < start_[key + 1]; ++k)
      if (same(entries_[order_[k]])) return entries_[order_[k]].p;
    return {};
  }

 private:
  std::vector<OldPair> entries_;
  std::vector<int> start_, order_;
};

}  // namespace

template <int dim>
CloseGrains<dim>::CloseGrains(std::span<const Vec<dim>> x, std::span<const double> r, const Box<dim>& box, double factor,
                              double skin)
    : x_(x), r_(r), box_(box), factor_(factor), skin_(skin), level_of_(x.size()), place_(x.size()) {
  const double r_min = r.empty() ? 1.0 : *std::min_element(r.begin(), r.end());
  for (std::size_t i = 0; i < x.size(); ++i) {
    const auto l = static_cast<std::size_t>(std::log2(r[i] / r_min));
    if (l >= levels_.size()) levels_.resize(l + 1);
    level_of_[i] = static_cast<std::uint8_t>(l);
    levels_[l].r_max = std::max(levels_[l].r_max, r[i]);
    levels_[l].grains.push_back(static_cast<int>(i));
  }
  const auto [low, high] = extent(x, box);
  std::vector<int> keys;
  for (Level& level : levels_) {
    if (level.grains.empty()) continue;
    level.low = low;
    level.cells = count_cells<dim>(low, high, factor * 2 * level.r_max + skin, 4.0 * level.grains.size() + 64);
    level.inv_size = inverse_size<dim>(low, high, level.cells);
    keys.clear();
    int total = 1;
    for (int c : level.cells) total *= c;
    for (int i : level.grains) {
      int key = 0;
      const auto c = own_cell(level, x[i]);
      for (int k = 0; k < dim; ++k) key = key * level.cells[k] + c[k];
      keys.push_back(key);
    }
    for (int k : sort_by_key(keys, total, level.start)) {
      place_[level.grains[k]] = static_cast<int>(level.member.size());
      level.member.push_back(level.grains[k]);
    }
  }
}

template <int dim>
std::array<int, dim> CloseGrains<dim>::own_cell(const Level& level, const Vec<dim>& x) const {
  return cell_at<dim>(x, level.low, level.inv_size, level.cells);
}

template <int dim>
typename Neighbours<dim>::Grid Neighbours<dim>::sort(Grains<dim>& grains, const Box<dim>& box) {
  const int n = grains.size();
  for (Vec<dim>& x : grains.x) x = box.wrap(x);
  double r_max = 0.0, r_mean = 0.0;
  for (double r : grains.r) r_max = std::max(r_max, r), r_mean += r / n;
  // A pair k cells apart (k >= 2) starts at least (k-1) B - d_max apart and, if neighbouring cells move by less than skin
  // relative to each other, nears by less than k skin: unlisted pairs far apart are safe when B >= d_max + 2 skin.
  // Larger cells cost less to check and allow less motion: three mean diameters was the best of two to five.
  const double size = std::max(2 * r_max + 2 * skin_, 6 * r_mean);
  const auto [low, high] = extent<dim>(grains.x, box);
  cells_ = count_cells<dim>(low, high, size, 2.0 * n + 64);
  const Vec<dim> inv = inverse_size<dim>(low, high, cells_);

  // Slowest along the longest side: blocks are slices of it and meet few others. A wide cell is cut once more for locality.
  std::array<int, dim> axes;
  std::iota(axes.begin(), axes.end(), 0);
  std::stable_sort(axes.begin(), axes.end(), [&](int a, int b) { return high[a] - low[a] > high[b] - low[b]; });
  const int cut = std::clamp(static_cast<int>(size / (6 * r_mean)), 1, 16);
  std::array<int, dim> fine;
  for (int k = 0; k < dim; ++k) fine[k] = cells_[k] * cut;
  const Vec<dim> inv_fine = inv * cut;
  int parts = 1, total = 1;
  for (int k = 0; k < dim; ++k) parts *= cut, total *= cells_[k];
  std::vector<int> keys(n), start;
  for (int i = 0; i < n; ++i) {
    const auto c = cell_at<dim>(grains.x[i], low, inv_fine, fine);
    int cell = 0, part = 0;
    for (int k : axes) cell = cell * cells_[k] + c[k] / cut, part = part * cut + c[k] % cut;
    keys[i] = cell * parts + part;
  }
  const std::vector<int> order = sort_by_key(keys, total * parts, start);
  cell_start_.resize(total + 1);
  for (int c = 0; c <= total; ++c) cell_start_[c] = start[c * parts];
  new_of_old_.resize(n);
  for (int k = 0; k < n; ++k) new_of_old_[order[k]] = k;
  permute(grains.x, order);
  permute(grains.body, order);
  permute(grains.r, order);
  permute(grains.id, order);
  permute(grains.wall, order);
  permute(grains.material, order);
  permute(grains.force, order);
  // valid() walks the cells in the order of `axes`
  std::array<int, dim> reordered;
  for (int k = 0; k < dim; ++k) reordered[k] = cells_[axes[k]], around_[k] = box.period[axes[k]] > 0;
  const Grid grid{low, inv, cells_, axes};
  cells_ = reordered;
  x_found_ = grains.x;
  return grid;
}

// Cells that the facet's bounding box, `margin` wider on every side, meets; those at the rim stand for what is outside.
template <int dim>
template <class Visit>
void Neighbours<dim>::each_cell_near(const Wall<dim>& facet, const Box<dim>& box, const Grid& grid, double margin, Visit&& visit) const {
  std::array<int, 3> first{0, 0, 0}, many{1, 1, 1};
  for (int k = 0; k < dim; ++k) {
    const auto [low, high] = std::minmax({0.0, facet.span[k], facet.side[k]});
    auto cell_of = [&](double x) {  // far away is no number of a cell
      return static_cast<int>(std::clamp(std::floor((x - grid.low[k]) * grid.inv_size[k]), -1e9, 1e9));
    };
    int begin = cell_of(facet.point[k] + low - margin), end = cell_of(facet.point[k] + high + margin);
    if (box.period[k] == 0) begin = std::clamp(begin, 0, grid.cells[k] - 1), end = std::clamp(end, 0, grid.cells[k] - 1);
    first[k] = begin, many[k] = std::min(end - begin + 1, grid.cells[k]);
  }
  for (int a = 0; a < many[0]; ++a)
    for (int b = 0; b < many[1]; ++b)
      for (int c = 0; c < many[2]; ++c) {
        const std::array<int, 3> step{a, b, c};
        int cell = 0;
        for (int k : grid.axes) {
          const int n = grid.cells[k];
          cell = cell * n + ((first[k] + step[k]) % n + n) % n;
        }
        visit(cell);
      }
}

// A facet k cells away from a grain's is at least k - 1 cells away from the grain.
template <int dim>
void Neighbours<dim>::measure_facets(const std::vector<Wall<dim>>& walls, const Box<dim>& box, const Grid& grid, double r_max) {
  const int n_cells = static_cast<int>(cell_start_.size()) - 1;
  double size = std::numeric_limits<double>::infinity();
  for (int k = 0; k < dim; ++k)
    if (grid.cells[k] > 1) size = std::min(size, 1 / grid.inv_size[k]);
  std::vector<int> away(n_cells, -1), reached;
  auto reach = [&](int cell, int cells_away) {
    if (away[cell] < 0) away[cell] = cells_away, reached.push_back(cell);
  };
  for (const Wall<dim>& wall : walls)
    if (wall.is_facet()) each_cell_near(wall, box, grid, 0.0, [&](int cell) { reach(cell, 0); });
  for (std::size_t k = 0; k < reached.size(); ++k)
    each_cell_beside(reached[k], [&](int other) { reach(other, away[reached[k]] + 1); });
  cell_facet_gap_.resize(n_cells);
  for (int c = 0; c < n_cells; ++c)
    cell_facet_gap_[c] = away[c] < 0 ? std::numeric_limits<double>::infinity()
                                     : std::max(2 * skin_, away[c] > 1 ? (away[c] - 1) * size - r_max : 0.0);
}

// Neighbouring cells, twice where a period has two cells.
template <int dim>
template <class Visit>
void Neighbours<dim>::each_cell_beside(int cell, Visit&& visit) const {
  std::array<int, 3> at{0, 0, 0}, n{1, 1, 1};
  for (int k = dim - 1, rest = cell; k >= 0; --k) n[k] = cells_[k], at[k] = rest % n[k], rest /= n[k];
  for (int code = 0; code <= shift_back<dim>(0); ++code) {
    int other = 0;
    bool outside = false;
    for (int k = 0, f = dim == 2 ? 3 : 9; k < dim; ++k, f /= 3) {
      int a = at[k] + code / f % 3 - 1;
      if (around_[k]) a = (a + n[k]) % n[k];
      outside |= a < 0 || a >= n[k];
      other = other * n[k] + a;
    }
    if (!outside && other != cell) visit(other);
  }
}

template <int dim>
void Neighbours<dim>::list(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, const Box<dim>& box, const Grid& grid,
                           int threads) {
  const int n = grains.size(), n_cells = static_cast<int>(cell_start_.size()) - 1, n_walls = static_cast<int>(walls.size());
  const double r_max = n > 0 ? *std::max_element(grains.r.begin(), grains.r.end()) : 0.0;
  std::vector<int> planes, cells, walls_in_cell, wall_start;  // planes are near every cell
  for (int w = 0; w < n_walls; ++w) {
    if (walls[w].is_facet()) each_cell_near(walls[w], box, grid, 2 * skin_ + r_max, [&](int c) { cells.push_back(c), walls_in_cell.push_back(w); });
    else planes.push_back(w);
  }
  std::vector<int> in_order = sort_by_key(cells, n_cells, wall_start);
  for (int& k : in_order) k = walls_in_cell[k];
  const CloseGrains<dim> close(grains.x, grains.r, box, 1.0, skin_);
  const int n_blocks = (n + block_size - 1) / block_size;
  found_in_block_.resize(n_blocks);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int b = 0; b < n_blocks; ++b) {
    Found& found = found_in_block_[b];
    found.pairs.clear();
    found.wall_pairs.clear();
    std::vector<int> near;  // walls that grains of the cell may be near, in their order
    int cell = -1;
    for (int i = b * block_size; i < std::min(n, (b + 1) * block_size); ++i) {
      close.visit(i, [&](int a, int c, int code) {
        if (grains.wall[a] >= 0 && grains.wall[c] >= 0) return;
        if (grains.id[a] > grains.id[c]) std::swap(a, c), code = shift_back<dim>(code);
        if (grains.wall[a] >= 0)  // grains fixed to a wall have the lower ids
          found.wall_pairs.push_back({grains.wall[a], a, c, code, {}});
        else
          found.pairs.push_back({a, c, code, {}});
      });
      if (grains.wall[i] >= 0) continue;
      if (cell < 0 || i >= cell_start_[cell + 1]) {
        cell = static_cast<int>(std::upper_bound(cell_start_.begin(), cell_start_.end(), i) - cell_start_.begin()) - 1;
        near = planes;
        near.insert(near.end(), in_order.begin() + wall_start[cell], in_order.begin() + wall_start[cell + 1]);
        std::sort(near.begin(), near.end());
      }
      for (const int w : near)
        if (nearest_point(walls[w], grains.x[i], box).distance - grains.r[i] < 2 * skin_)
          found.wall_pairs.push_back({w, -1, i, shift_back<dim>(0) / 2, {}});
    }
  }
  // What valid() needs to know of the grains that are not listed with a wall
  measure_facets(walls, box, grid, r_max);
  cell_wall_gap_.assign(planes.size() * n_cells, 0.0);
  for (std::size_t p = 0; p < planes.size(); ++p)
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int c = 0; c < n_cells; ++c) {
      double gap = std::numeric_limits<double>::infinity();
      for (int i = cell_start_[c]; i < cell_start_[c + 1]; ++i) {
        if (grains.wall[i] >= 0) continue;
        const double g = nearest_point(walls[planes[p]], grains.x[i], box).distance - grains.r[i];
        if (g >= 2 * skin_) gap = std::min(gap, g);
      }
      cell_wall_gap_[p * n_cells + c] = gap;
    }
}

template <int dim>
void Neighbours<dim>::arrange(int n, int threads) {
  const int n_blocks = static_cast<int>(found_in_block_.size());
  // Which blocks a block's pairs write to; two blocks that write to a common one need different colours.
  std::vector<std::vector<int>> touches(n_blocks), touched_by(n_blocks);
  std::vector<int> mark(n_blocks, -1);
  for (int b = 0; b < n_blocks; ++b)
    for (const Pair<dim>& pair : found_in_block_[b].pairs)
      for (int t : {pair.i / block_size, pair.j / block_size})
        if (mark[t] != b) mark[t] = b, touches[b].push_back(t), touched_by[t].push_back(b);
  std::vector<int> colour(n_blocks, -1), taken;
  int n_colours = 0;
  for (int b = 0; b < n_blocks; ++b) {
    taken.assign(n_colours + 1, 0);
    for (int t : touches[b])
      for (int other : touched_by[t])
        if (colour[other] >= 0) taken[colour[other]] = 1;
    colour[b] = static_cast<int>(std::find(taken.begin(), taken.end(), 0) - taken.begin());
    n_colours = std::max(n_colours, colour[b] + 1);
  }
  const std::vector<int> order = sort_by_key(colour, n_colours, colours);
  blocks.resize(n_blocks);
  int total = 0;
  for (int k = 0; k < n_blocks; ++k) {
    const int size = static_cast<int>(found_in_block_[order[k]].pairs.size());
    blocks[k] = {total, total + size};
    total += size;
  }
  pairs.resize(total);
#pragma omp parallel num_threads(threads)
  {
    std::vector<std::uint64_t> used(n, 0);  // colours of the pairs of a grain, in this block
    std::vector<int> keys, start;
#pragma omp for schedule(static)
    for (int k = 0; k < n_blocks; ++k) {
      const auto& found = found_in_block_[order[k]].pairs;
      keys.clear();
      for (const Pair<dim>& pair : found) {
        const int c = std::min(std::countr_one(used[pair.i] | used[pair.j]), 63);
        used[pair.i] |= std::uint64_t{1} << c;
        used[pair.j] |= std::uint64_t{1} << c;
        keys.push_back(c);
      }
      for (const Pair<dim>& pair : found) used[pair.i] = used[pair.j] = 0;
      int at = blocks[k].begin;
      for (int f : sort_by_key(keys, 64, start)) pairs[at++] = found[f];
    }
  }
}

template <int dim>
void Neighbours<dim>::find(Grains<dim>& grains, std::vector<Wall<dim>>& walls, const Box<dim>& box, double skin,
                           int threads) {
  ++found;
  skin_ = skin;
  shifts.clear();
  for (int code = 0; code <= shift_back<dim>(0); ++code) shifts.push_back(periodic_shift(box, code));
  for (Wall<dim>& wall : walls) wall.moved.setZero();
  const int n = grains.size();

  const Grid grid = sort(grains, box);
  auto renumber = [&](int i) { return i < 0 ? i : new_of_old_[i]; };
  const Known<dim, Pair<dim>> known(pairs, n, [&](Pair<dim>& old) {
    old.i = renumber(old.i), old.j = renumber(old.j);
    return old.i;
  });
  const Known<dim, WallPair<dim>> known_walls(wall_pairs, n, [&](WallPair<dim>& old) {
    old.fixed = renumber(old.fixed), old.j = renumber(old.j);
    return old.j;
  });
  list(grains, walls, box, grid, threads);
  arrange(n, threads);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (std::size_t k = 0; k < pairs.size(); ++k)
    pairs[k].p = known.find(pairs[k].i, [&](const Pair<dim>& old) { return old.j == pairs[k].j; });
  wall_pairs.clear();
  for (const Found& in_block : found_in_block_)
    for (WallPair<dim> pair : in_block.wall_pairs) {
      pair.p = known_walls.find(pair.j, [&](const WallPair<dim>& old) {
        return old.wall == pair.wall && old.fixed == pair.fixed;
      });
      wall_pairs.push_back(pair);
    }
}

template <int dim>
void Neighbours<dim>::remove(std::span<const int> new_of_old) {
  int at = 0;
  for (Block& block : blocks) {
    const int begin = at;
    for (int k = block.begin; k < block.end; ++k) {
      Pair<dim> pair = pairs[k];
      pair.i = new_of_old[pair.i], pair.j = new_of_old[pair.j];
      if (pair.i >= 0 && pair.j >= 0) pairs[at++] = pair;
    }
    block = {begin, at};
  }
  pairs.resize(at);
  for (WallPair<dim>& pair : wall_pairs) {
    pair.j = new_of_old[pair.j];
    if (pair.fixed >= 0) pair.fixed = new_of_old[pair.fixed];
  }
  std::erase_if(wall_pairs, [](const WallPair<dim>& pair) { return pair.j < 0; });
  // Cells lose grains, but what was found of them still bounds the others.
  const int n = static_cast<int>(x_found_.size());
  std::vector<int> kept(n + 1, 0);  // of the first so many
  for (int i = 0; i < n; ++i) {
    kept[i + 1] = kept[i] + (new_of_old[i] >= 0);
    if (new_of_old[i] >= 0) x_found_[new_of_old[i]] = x_found_[i];
  }
  x_found_.resize(kept[n]);
  for (int& start : cell_start_) start = kept[start];
}

template <int dim>
bool Neighbours<dim>::valid(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, double reach, double h,
                            int threads) {
  if (grains.size() == 0) return true;
  return skin_ >= 0 && within(grains, walls, reach, 0.0, threads) && (h == 0 || within(grains, walls, reach, h, threads));
}

// Whether the ways since neighbours were found, and for another time h, are too alike for an unlisted pair to come within reach.
template <int dim>
bool Neighbours<dim>::within(const Grains<dim>& grains, const std::vector<Wall<dim>>& walls, double reach, double h,
                             int threads) {
  const int n_cells = static_cast<int>(cell_start_.size()) - 1;
  cell_mean_.resize(n_cells);
  cell_spread_.resize(n_cells);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int c = 0; c < n_cells; ++c) {
    const int begin = cell_start_[c], end = cell_start_[c + 1];
    Vec<dim> mean = Vec<dim>::Zero();
    auto way = [&](int i) -> Vec<dim> { return grains.x[i] - x_found_[i] + h * grains.body[i].v; };
    for (int i = begin; i < end; ++i) mean += way(i);
    if (end > begin) mean /= end - begin;
    double spread2 = 0.0;
    for (int i = begin; i < end; ++i) spread2 = std::max(spread2, (way(i) - mean).squaredNorm());
    cell_mean_[c] = mean;
    cell_spread_[c] = std::sqrt(spread2);
  }
  // An empty cell may carry any value (the bound is a chain through neighbouring cells): its neighbours' mean costs least.
  for (int c = 0; c < n_cells; ++c) {
    if (cell_start_[c] != cell_start_[c + 1]) continue;
    Vec<dim> mean = Vec<dim>::Zero();
    int n = 0;
    each_cell_beside(c, [&](int other) {
      if (cell_start_[other] != cell_start_[other + 1]) mean += cell_mean_[other], ++n;
    });
    if (n > 0) cell_mean_[c] = mean / n;
  }
  double nearing = 0.0;
#pragma omp parallel for num_threads(threads) schedule(static) reduction(max : nearing)
  for (int c = 0; c < n_cells; ++c) {
    nearing = std::max(nearing, 2 * cell_spread_[c]);
    each_cell_beside(c, [&](int other) {
      if (other < c) return;
      nearing = std::max(nearing, cell_spread_[c] + cell_spread_[other] + (cell_mean_[c] - cell_mean_[other]).norm());
    });
  }
  if (nearing + reach > skin_) return false;
  std::vector<Vec<dim>> facet_ways;  // many facets move as one
  const double* gap = cell_wall_gap_.data();
  for (const Wall<dim>& wall : walls) {
    const Vec<dim> wall_way = wall.moved + h * wall.v;
    if (wall.is_facet()) {
      if (std::find(facet_ways.begin(), facet_ways.end(), wall_way) == facet_ways.end()) facet_ways.push_back(wall_way);
      continue;
    }
    for (int c = 0; c < n_cells; ++c, ++gap)
      if (cell_start_[c] != cell_start_[c + 1] && cell_spread_[c] + reach - (cell_mean_[c] - wall_way).dot(wall.normal) > *gap) return false;
  }
  for (const Vec<dim>& facet_way : facet_ways)
    for (int c = 0; c < n_cells; ++c)
      if (cell_start_[c] != cell_start_[c + 1] && (cell_mean_[c] - facet_way).norm() + cell_spread_[c] + reach > cell_facet_gap_[c]) return false;
  return true;
}

template class CloseGrains<2>;
template class CloseGrains<3>;
template class Neighbours<2>;
template class Neighbours<3>;

}  // namespace quicksand
