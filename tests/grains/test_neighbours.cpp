// Detection against brute force: which pairs are listed, in which order, and for how long the list may be trusted.
#include "scenes.hpp"

#include <set>

namespace quicksand::test {
namespace {

template <class D>
class Detection : public ::testing::Test {};
TYPED_TEST_SUITE(Detection, Dimensions, DimensionName);

// Grains at random, radii 0.2 to 6 mm with as many in each octave, a tenth of them fixed to the first of two walls; periodic along
// the first axis. They overlap at will: detection does not mind.
template <int dim>
struct Crowd {
  Grains<dim> grains;
  std::vector<Wall<dim>> walls;
  Box<dim> box;
  Neighbours<dim> neighbours;
  std::mt19937 random;

  Crowd(int n, unsigned seed) : random(seed) {
    box.period[0] = 0.1;
    std::uniform_real_distribution<double> octave(std::log(0.2e-3), std::log(6e-3));
    int fixed = 0, free = 0;
    for (int k = 0; k < n; ++k) {
      const bool on_wall = random() % 10 == 0;
      grains.x.push_back(random_vector<dim>(random, dim == 2 ? 0.1 : 0.05));
      grains.r.push_back(std::exp(octave(random)));
      Body<dim> body;
      body.v.setZero(), body.s = zero<Spin<dim>>(), body.inv_m = !on_wall;
      grains.body.push_back(body);
      grains.id.push_back(on_wall ? -(++fixed) : free++);
      grains.wall.push_back(on_wall ? 0 : -1);
      grains.material.push_back(0);
    }
    walls.resize(dim);
    walls[0].point[1] = -0.09, walls[0].normal[1] = 1;
    walls[1].point[1] = 0.03;
    if constexpr (dim == 2) {
      walls[1].shape = Wall<dim>::Shape::segment;
      walls[1].span = Vec<2>(0.07, 0.01);
      walls[1].normal = Vec<2>(-0.01, 0.07).normalized();
    } else {
      walls[1].normal[1] = -1;
      walls[2].shape = Wall<dim>::Shape::triangle;
      walls[2].point = Vec<3>(0.03, -0.03, -0.02);  // its second corner is beyond the boundary at 0.05
      walls[2].span = Vec<3>(0.04, 0.02, 0), walls[2].side = Vec<3>(0, 0.01, 0.04);
      walls[2].normal = cross(walls[2].span, walls[2].side).normalized();
    }
    for (int f = 0; f < 20; ++f) {  // small facets, also where there are no grains
      Wall<dim> facet;
      facet.shape = dim == 2 ? Wall<dim>::Shape::segment : Wall<dim>::Shape::triangle;
      facet.point = random_vector<dim>(random, 0.15), facet.span = random_vector<dim>(random, 0.01), facet.side = random_vector<dim>(random, 0.01);
      if constexpr (dim == 2) facet.side.setZero(), facet.normal = Vec<2>(-facet.span[1], facet.span[0]).normalized();
      else facet.normal = cross(facet.span, facet.side).normalized();
      walls.push_back(facet);
    }
  }
  double gap(int i, int j) const { return box.nearest(grains.x[j] - grains.x[i]).norm() - grains.r[i] - grains.r[j]; }
  double wall_gap(int w, int j) const { return nearest_point(walls[w], grains.x[j], box).distance - grains.r[j]; }
  bool fixed(int i) const { return grains.wall[i] >= 0; }

  // Every unlisted pair that is nearer than `reach`: numbers of grains, or -1 - wall and a grain. Fails on what is listed twice.
  std::vector<std::pair<int, int>> missed(double reach) const {
    std::set<std::pair<int, int>> listed;
    auto list = [&](int i, int j) {
      EXPECT_TRUE(listed.insert({i, j}).second) << "twice: " << i << ", " << j;
      if (i >= 0) listed.insert({j, i});
    };
    for (const Pair<dim>& pair : neighbours.pairs) list(pair.i, pair.j);
    for (const WallPair<dim>& pair : neighbours.wall_pairs) list(pair.fixed >= 0 ? pair.fixed : -1 - pair.wall, pair.j);
    std::vector<std::pair<int, int>> out;
    for (int j = 0; j < grains.size(); ++j) {
      for (int i = 0; i < j; ++i)
        if (gap(i, j) < reach && !(fixed(i) && fixed(j)) && !listed.contains({i, j})) out.push_back({i, j});
      for (int w = 0; w < static_cast<int>(walls.size()); ++w)
        if (wall_gap(w, j) < reach && !fixed(j) && !listed.contains({-1 - w, j})) out.push_back({-1 - w, j});
    }
    return out;
  }
};

TYPED_TEST(Detection, every_pair_nearer_than_the_skin_is_listed_once_with_its_nearest_image) {
  constexpr int dim = TypeParam::value;
  for (unsigned seed = 1; seed <= 5; ++seed) {
    Crowd<dim> crowd(seed == 1 ? 1000 : 300, seed);
    for (double skin : {0.0, 0.3e-3, 3e-3}) {
      crowd.neighbours.find(crowd.grains, crowd.walls, crowd.box, skin, 2);
      EXPECT_TRUE(crowd.missed(skin).empty());
      for (const Pair<dim>& pair : crowd.neighbours.pairs) {
        EXPECT_LT(crowd.grains.id[pair.i], crowd.grains.id[pair.j]);
        EXPECT_LT(crowd.gap(pair.i, pair.j), skin + 1e-12);  // nothing that should not be there
        const Vec<dim> branch = crowd.grains.x[pair.j] - crowd.grains.x[pair.i] + crowd.neighbours.shifts[pair.shift];
        EXPECT_LT((branch - crowd.box.nearest(branch)).norm(), 1e-12);
      }
      for (const WallPair<dim>& pair : crowd.neighbours.wall_pairs) {
        if (pair.fixed < 0) continue;
        EXPECT_TRUE(crowd.fixed(pair.fixed) && !crowd.fixed(pair.j));
        const Vec<dim> branch = crowd.grains.x[pair.j] - crowd.grains.x[pair.fixed] + crowd.neighbours.shifts[pair.shift];
        EXPECT_LT((branch - crowd.box.nearest(branch)).norm(), 1e-12);
      }
    }
  }
}

TYPED_TEST(Detection, blocks_of_one_colour_share_no_grain_so_that_threads_may_sweep_them_at_once) {
  constexpr int dim = TypeParam::value;
  Crowd<dim> crowd(3000, 6);
  crowd.neighbours.find(crowd.grains, crowd.walls, crowd.box, 0.3e-3, 2);
  const auto& [pairs, blocks, colours] = std::tie(crowd.neighbours.pairs, crowd.neighbours.blocks, crowd.neighbours.colours);
  ASSERT_EQ(colours.front(), 0);
  ASSERT_EQ(colours.back(), static_cast<int>(blocks.size()));
  EXPECT_LT(colours.size(), blocks.size());  // else nothing is swept at once
  std::size_t in_blocks = 0;
  for (std::size_t c = 0; c + 1 < colours.size(); ++c) {
    std::vector<int> block_of(crowd.grains.size(), -1);
    for (int b = colours[c]; b < colours[c + 1]; ++b)
      for (int k = blocks[b].begin; k < blocks[b].end; ++k, ++in_blocks)
        for (int grain : {pairs[k].i, pairs[k].j}) {
          ASSERT_TRUE(block_of[grain] == -1 || block_of[grain] == b) << "grain " << grain << ", colour " << c;
          block_of[grain] = b;
        }
  }
  EXPECT_EQ(in_blocks, pairs.size());
}

TYPED_TEST(Detection, impulses_follow_their_pair_when_grains_are_sorted_anew) {
  constexpr int dim = TypeParam::value;
  Crowd<dim> crowd(500, 7);
  crowd.neighbours.find(crowd.grains, crowd.walls, crowd.box, 0.3e-3, 1);
  auto mark = [&](int i, int j) { return 1.0 + 1000 * (1000 + crowd.grains.id[i]) + crowd.grains.id[j]; };
  for (Pair<dim>& pair : crowd.neighbours.pairs) pair.p.n = mark(pair.i, pair.j);
  for (WallPair<dim>& pair : crowd.neighbours.wall_pairs)
    pair.p.n = pair.fixed >= 0 ? mark(pair.fixed, pair.j) : 1e7 * pair.wall + 1e8 + crowd.grains.id[pair.j];
  const std::size_t pairs = crowd.neighbours.pairs.size(), wall_pairs = crowd.neighbours.wall_pairs.size();
  for (Vec<dim>& x : crowd.grains.x) x += in_plane<dim>(0.037, 0.0);  // through the boundary: another order
  for (Wall<dim>& wall : crowd.walls) wall.point[0] += 0.037;
  crowd.neighbours.find(crowd.grains, crowd.walls, crowd.box, 0.3e-3, 1);
  ASSERT_EQ(crowd.neighbours.pairs.size(), pairs);
  ASSERT_EQ(crowd.neighbours.wall_pairs.size(), wall_pairs);
  for (const Pair<dim>& pair : crowd.neighbours.pairs) EXPECT_EQ(pair.p.n, mark(pair.i, pair.j));
  for (const WallPair<dim>& pair : crowd.neighbours.wall_pairs)
    EXPECT_EQ(pair.p.n, pair.fixed >= 0 ? mark(pair.fixed, pair.j) : 1e7 * pair.wall + 1e8 + crowd.grains.id[pair.j]);
}

// Motions of every kind: together, sheared, at random, one grain across the scene, two crowds towards each other over empty space.
TYPED_TEST(Detection, the_list_is_never_trusted_while_an_unlisted_pair_is_nearer_than_the_reach) {
  constexpr int dim = TypeParam::value;
  const double skin = 1e-3, reach = 0.2e-3;
  int trusted = 0, distrusted = 0;
  for (unsigned seed = 1; seed <= 60; ++seed) {
    Crowd<dim> crowd(seed % 2 ? 150 : 400, seed);
    const bool apart = seed % 3 == 0;  // the middle is left empty
    for (Vec<dim>& x : crowd.grains.x)
      if (apart && std::abs(x[1]) < 0.03) x[1] += std::copysign(0.03, x[1]);
    crowd.neighbours.find(crowd.grains, crowd.walls, crowd.box, skin, 1);
    auto& random = crowd.random;
    auto amplitude = [&] { return 1e-4 * std::exp2(random() % 8) * (random() % 2); };
    const Vec<dim> together = random_vector<dim>(random, amplitude()), shear = random_vector<dim>(random, amplitude());
    const double noise = 0.1 * amplitude(), closing = apart ? amplitude() : 0.0;
    for (Vec<dim>& x : crowd.grains.x)
      x += together + shear * (x[1] / 0.1) + random_vector<dim>(random, noise) - Vec<dim>::Unit(1) * std::copysign(closing, x[1]);
    if (seed % 5 == 0) crowd.grains.x[random() % crowd.grains.size()] += random_vector<dim>(random, 0.05);
    const Vec<dim> facet_way = together + random_vector<dim>(random, 0.5 * amplitude());  // those of a mesh move as one
    for (Wall<dim>& wall : crowd.walls) {
      const Vec<dim> way = wall.is_facet() ? facet_way : Vec<dim>(together + random_vector<dim>(random, 0.5 * amplitude()));
      wall.point += way, wall.moved += way;
    }
    const bool valid = crowd.neighbours.valid(crowd.grains, crowd.walls, reach, 0.0, 1);
    (valid ? trusted : distrusted)++;
    EXPECT_TRUE(!valid || crowd.missed(reach).empty()) << seed;
  }
  EXPECT_GT(trusted, 5);
  EXPECT_GT(distrusted, 5);
}

// The bound is on relative motion: grains and walls that move together by any way keep their list.
TYPED_TEST(Detection, motion_that_all_share_does_not_end_the_list) {
  constexpr int dim = TypeParam::value;
  Crowd<dim> crowd(300, 8);
  EXPECT_FALSE(crowd.neighbours.valid(crowd.grains, crowd.walls, 0.0, 0.0, 1));  // nothing is listed yet
  crowd.neighbours.find(crowd.grains, crowd.walls, crowd.box, 1e-3, 1);
  const Vec<dim> way = random_vector<dim>(crowd.random, 1.0);
  for (Vec<dim>& x : crowd.grains.x) x += way;
  for (Wall<dim>& wall : crowd.walls) wall.point += way, wall.moved += way;
  EXPECT_TRUE(crowd.neighbours.valid(crowd.grains, crowd.walls, 0.9e-3, 0.0, 1));
  EXPECT_FALSE(crowd.neighbours.valid(crowd.grains, crowd.walls, 1.1e-3, 0.0, 1));  // farther than was listed
}

}  // namespace
}  // namespace quicksand::test
