// What grains weigh at the nodes of a mesh: the one link between the two phases. W_ai >= 0, sum over nodes a of W_ai = 1 for each grain i.
//   volume      1 - eps_a = sum_i V_i W_ai/M_a,          M_a = int N_a, so that int (1 - eps) is the volume of the grains, to rounding
//   to a grain  f_i = sum_a W_ai f_a,                    f_a = int N_a f/M_a
//   to nodes    F_a = sum_i W_ai F_i/M_a  [N/m^3],       adjoint: int F . u = sum_i F_i . u_i, whatever u
// Two kernels. The hat: W_ai = N_a(x_i), of the element that holds the grain. The smooth one, of a radius r_0 that knows no mesh:
//   W_ai = b(x_i) int N_a(x) b(x) K(x - x_i) dx,   K = (1 - r^2/R^2)^3 within R, of standard deviation r_0 along each axis,
// twice differentiable, and so is eps in time. b > 0 makes it doubly stochastic, int b(x) b(y) K(x - y) dx = 1 for all y, as heat that spreads between
// insulated walls: grains near a wall lose nothing and take nothing from each other, a uniform field of grains reads uniform along flat walls, in
// corners and on curved ones, with no image of a grain to be made. b = 1/sqrt(int K) but near walls. R. Sinkhorn, Ann. Math. Stat. 35 (1964).
#pragma once

#include "walker.hpp"

namespace quicksand::coupling {

enum class Shape { hat, smooth };

template <int dim>
struct Weights {  // of grain i at the nodes: from start[i] to start[i + 1]
  std::vector<int> start, node;  // nodes that are their own masters
  std::vector<double> weight;
};

template <int dim>
class Kernel {
 public:
  // `period` [m] along the axes of the grains' box, 0 where not periodic. Throws std::invalid_argument where the mesh is too coarse for r_0.
  Kernel(std::shared_ptr<const Mesh<dim>> mesh, Shape shape, double radius, const Vec<dim>& period);

  // The mesh has moved; also at the start. b goes on from where it was.
  void place(const std::vector<Vec<dim>>& nodes);
  // Grains in the elements that `places` tells, inside the periods of the mesh.
  const Weights<dim>& weigh(std::span<const Vec<dim>> x, const std::vector<Place<dim>>& places);
  const Weights<dim>& weights() const { return weights_; }
  const std::vector<double>& masses() const { return masses_; }  // M_a of each node, of an image that of its master [m^dim]

  // b at the samples: part of the state.
  std::vector<double>& balance() { return b_; }
  const std::vector<double>& balance() const { return b_; }

 private:
  struct Sample {  // a point of the integral over x
    Vec<dim> x;
    double volume;  // [m^dim]
    std::array<int, dim + 1> node;
    Barycentric<dim> l;
  };
  struct Near {  // a sample, or its image across a period, in the cell of a grid
    Vec<dim> x;
    double weight;  // volume b
    int sample;
  };
  void sort();
  void balance_once();
  template <class Use>
  void within(const Vec<dim>& x, Use&& use) const;

  std::shared_ptr<const Mesh<dim>> mesh_;
  Shape shape_;
  double reach_;  // R [m]
  Vec<dim> period_;
  std::vector<Barycentric<dim>> in_element_;  // of the samples
  std::vector<Sample> samples_;
  std::vector<double> b_, masses_;
  std::vector<Near> near_;
  std::vector<int> cell_start_;
  std::array<int, dim> cells_;
  Vec<dim> low_;
  Weights<dim> weights_;
  std::vector<double> sum_;  // at nodes, of one grain
  std::vector<int> touched_;
};

}  // namespace quicksand::coupling
