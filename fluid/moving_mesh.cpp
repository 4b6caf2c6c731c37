// Where the mesh goes with its boundaries, and what that means for volumes.
#include "facet.hpp"
#include "fluid.hpp"

#include "meshes/errors.hpp"

#include <Eigen/Sparse>

#include <algorithm>

namespace quicksand::fluid {

using meshes::fail;
using meshes::place;

template <int dim>
void Fluid<dim>::move_boundary(const std::string& boundary, VectorField<dim> velocity) {
  motion_[outer_boundary("move_boundary", boundary)] = std::move(velocity);
  harmonic_.reset();
}

// int q (change of eps at a fixed point) over a step, for each q of a vertex: int q (eps - eps before) on the mesh before, less what the
// moving mesh has swept. Summed over q it is the change of int eps less the flux of eps through the moving boundary, exactly.
template <int dim>
std::vector<double> Fluid<dim>::eps_change(double dt) const {
  std::vector<double> change(space_.nodes(), 0.0);
  const bool moves = std::any_of(mesh_velocity_.begin(), mesh_velocity_.end(), [](const Vec<dim>& w) { return !w.isZero(0.0); });
  auto sum = [&]<int order>(std::integral_constant<int, order>) {
    using T = std::conditional_t<order == 1, Lanes, double>;
    using Vector = VecOf<dim, T>;
    constexpr int n = shape_count<dim, order>;
    const int elements = static_cast<int>(mesh_->elements.size());
    for (int first = 0; first < elements; first += lanes_of<T>) {
      const int count = std::min(lanes_of<T>, elements - first);
      std::array<Vector, dim + 1> before, now, velocity;
      std::array<T, n> eps, eps_before;
      for (int lane = 0; lane < lanes_of<T>; ++lane) {
        const std::size_t e = first + std::min(lane, count - 1);
        for (int a = 0; a <= dim; ++a) {
          const int k = mesh_->elements[e][a];
          put(before[a], lane, old_position_[k]), put(now[a], lane, position_[k]), put(velocity[a], lane, mesh_velocity_[k]);
        }
        for (int a = 0; a < n; ++a) put(eps[a], lane, eps_[0][space_.node_of[e * n + a]]), put(eps_before[a], lane, eps_[1][space_.node_of[e * n + a]]);
      }
      std::array<T, dim + 1> of_corners;
      of_corners.fill(0.0);
      auto integrate = [&](double share, auto&& rate) {  // on the mesh at old + share (new - old)
        std::array<Vector, dim + 1> x;
        for (int a = 0; a <= dim; ++a) x[a] = (1 - share) * before[a] + share * now[a];
        const Geometry<dim, T> g = geometry<dim, T>(x);
        for (const auto& point : quadrature<dim, order>()) {
          const T value = rate(point, g) * point.weight * g.volume;
          for (int a = 0; a <= dim; ++a) of_corners[a] += point.l[a] * value;
        }
      };
      integrate(0.0, [&](const auto& point, const auto&) {
        const auto shape = shapes<dim, order>(point.l);
        T d = 0.0;
        for (int a = 0; a < n; ++a) d += shape[a] * (eps[a] - eps_before[a]);
        return d;
      });
      if (moves)
        for (const double side : {-1.0, 1.0})  // Gauss: exact for the cubic polynomial in time
          integrate(0.5 + side * 0.5 / std::sqrt(3.0), [&](const auto& point, const Geometry<dim, T>& g) {
            const auto grad = shape_gradients<dim, order, T>(point.l, g.grad_l);
            Vector slope = Vector::Zero(), w = Vector::Zero();
            for (int a = 0; a < n; ++a) slope += eps[a] * grad[a];
            for (int a = 0; a <= dim; ++a) w += point.l[a] * velocity[a];
            return T(-0.5 * dt * w.dot(slope));
          });
      for (int lane = 0; lane < count; ++lane)
        for (int a = 0; a <= dim; ++a) change[space_.node_of[(first + lane) * n + a]] += get(of_corners[a], lane);
    }
  };
  with_order(velocity_order(), sum);
  return change;
}

template <int dim>
double Fluid<dim>::pore_volume(const std::vector<double>& eps) const {
  double sum = 0.0;
  auto add = [&]<int order>(std::integral_constant<int, order>) {
    for (std::size_t e = 0; e < mesh_->elements.size(); ++e) {
      double mean = 0.0;
      for (const auto& point : quadrature<dim, order>()) {
        const auto shape = shapes<dim, order>(point.l);
        for (int a = 0; a < shape_count<dim, order>; ++a) mean += point.weight * shape[a] * eps[space_.node_of[e * space_.per_element + a]];
      }
      sum += geometry<dim>(position_, mesh_->elements[e]).volume * mean;
    }
  };
  with_order(velocity_order(), add);
  return sum;
}

// int int eps w . n dA dt over a step, with eps of its end carried along: exact, as in eps_change().
template <int dim>
double Fluid<dim>::swept(int boundary, double dt) const {
  double sum = 0.0;
  auto add = [&]<int order>(std::integral_constant<int, order>) {
    for (const double side : {-1.0, 1.0}) {
      const double share = 0.5 + side * 0.5 / std::sqrt(3.0);
      for (const int f : facets_of_[boundary]) {
        const FacetView<dim> facet(*mesh_, f, [&](int k) { return Vec<dim>((1 - share) * old_position_[k] + share * position_[k]); });
        along<dim>(facet, [&](const Barycentric<dim>& l, double weight) {
          const auto shape = shapes<dim, order>(l);
          double eps = 0.0;
          Vec<dim> w = Vec<dim>::Zero();
          for (int a = 0; a < shape_count<dim, order>; ++a) eps += shape[a] * eps_[0][space_.node_of[facet.element * space_.per_element + a]];
          for (int a = 0; a <= dim; ++a) w += l[a] * mesh_velocity_[mesh_->elements[facet.element][a]];
          sum += 0.5 * dt * weight * eps * w.dot(facet.area);
        });
      }
    }
  };
  with_order(velocity_order(), add);
  return sum;
}

// Factors of the mesh's Laplacian, for each component with its own held nodes.
template <int dim>
struct Fluid<dim>::Harmonic {
  std::array<std::vector<int>, dim> row;  // of each velocity node among the free ones, or -1
  std::array<Eigen::SparseMatrix<double>, dim> held;  // what held nodes do to free rows
  std::array<Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>, dim> factors;
};

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::harmonic(const std::vector<std::vector<int>>& moved, const std::vector<std::vector<Vec<dim>>>& velocity) {
  std::vector<Vec<dim>> at_node(space_.nodes(), Vec<dim>::Zero());
  for (std::size_t k = 0; k < moved.size(); ++k)
    for (std::size_t m = 0; m < moved[k].size(); ++m) at_node[space_.vertex[moved[k][m]]] = velocity[k][m];
  if (!harmonic_) {
    harmonic_ = std::make_shared<Harmonic>();
    std::array<std::vector<char>, dim> is_held;
    for (auto& held : is_held) held.assign(space_.nodes(), false);
    for (std::size_t f = 0; f < mesh_->facets.size(); ++f) {
      if (mesh_->facet_elements[f][1] >= 0) continue;
      const Vec<dim> normal = FacetView<dim>(*mesh_, mesh_->nodes, static_cast<int>(f)).area.normalized();
      for (const int k : mesh_->facets[f])
        for (int axis = 0; axis < dim; ++axis) is_held[axis][space_.vertex[k]] |= motion_[mesh_->boundary[f]] || std::abs(normal[axis]) > 1e-6;
    }
    for (int axis = 0; axis < dim; ++axis) {
      auto& row = harmonic_->row[axis];
      row.assign(space_.nodes(), -1);
      int free = 0;
      for (int node = 0; node < space_.nodes(); ++node)
        if (space_.is_vertex(node) && !is_held[axis][node]) row[node] = free++;
      std::vector<Eigen::Triplet<double>> inner, outer;
      for (const auto& element : mesh_->elements) {
        const Geometry<dim> g = geometry<dim>(mesh_->nodes, element);
        for (int a = 0; a <= dim; ++a)
          for (int b = 0; b <= dim; ++b) {
            const int i = space_.vertex[element[a]], j = space_.vertex[element[b]];
            if (row[i] < 0) continue;
            const double value = g.volume * g.grad_l[a].dot(g.grad_l[b]);
            row[j] < 0 ? outer.emplace_back(row[i], j, value) : inner.emplace_back(row[i], row[j], value);
          }
      }
      Eigen::SparseMatrix<double> laplacian(free, free);
      laplacian.setFromTriplets(inner.begin(), inner.end());
      harmonic_->held[axis].resize(free, space_.nodes());
      harmonic_->held[axis].setFromTriplets(outer.begin(), outer.end());
      if (free > 0) harmonic_->factors[axis].compute(laplacian);
      if (free > 0 && harmonic_->factors[axis].info() != Eigen::Success)
        fail("step: nothing holds the nodes of the mesh along axis {}; move a boundary with move_boundary", axis);
    }
  }
  for (int axis = 0; axis < dim; ++axis) {
    if (harmonic_->held[axis].rows() == 0) continue;
    Eigen::VectorXd known(space_.nodes());
    for (int node = 0; node < space_.nodes(); ++node) known[node] = at_node[node][axis];
    if (known.isZero(0.0)) continue;
    const Eigen::VectorXd found = harmonic_->factors[axis].solve(-(harmonic_->held[axis] * known));
    for (int node = 0; node < space_.nodes(); ++node)
      if (harmonic_->row[axis][node] >= 0) at_node[node][axis] = found[harmonic_->row[axis][node]];
  }
  std::vector<Vec<dim>> w;
  for (const int node : space_.vertex) w.push_back(at_node[node]);
  return w;
}

template <int dim>
std::vector<Vec<dim>> Fluid<dim>::stretch(const std::vector<std::vector<int>>& moved, const std::vector<std::vector<Vec<dim>>>& velocity) const {
  std::vector<Vec<dim>> place, w;
  for (std::size_t k = 0; k < moved.size(); ++k) {
    if (moved[k].empty()) continue;
    place.push_back(Vec<dim>::Zero()), w.push_back(velocity[k][0]);
    for (std::size_t m = 0; m < moved[k].size(); ++m) {
      place.back() += position_[moved[k][m]] / moved[k].size();
      if ((velocity[k][m] - w.back()).norm() > 1e-12 * w.back().norm())
        fail("step: mesh_motion \"stretch\" needs boundaries that move as a whole, but \"{}\" does not; use \"harmonic\"", mesh_->boundary_names[k]);
    }
  }
  if (place.size() != 2) fail("step: mesh_motion \"stretch\" is between two boundaries that move, got {}; move the other one with velocity 0, or use \"harmonic\"", place.size());
  // The axis that tells them apart: their centres may be shifted along the others.
  int axis;
  (place[1] - place[0]).cwiseAbs().maxCoeff(&axis);
  std::vector<Vec<dim>> at_nodes;
  for (const Vec<dim>& x : position_) {
    const double share = (x[axis] - place[0][axis]) / (place[1][axis] - place[0][axis]);
    at_nodes.push_back((1 - share) * w[0] + share * w[1]);
  }
  return at_nodes;
}

// Moves the mesh over a step. Throws, with the mesh where it was, when an element would fold.
template <int dim>
void Fluid<dim>::move_mesh(double t, double dt) {
  if (std::none_of(motion_.begin(), motion_.end(), [](const auto& m) { return static_cast<bool>(m); })) return;
  std::vector<std::vector<int>> moved(motion_.size());  // mesh nodes of each boundary that moves
  std::vector<std::vector<Vec<dim>>> velocity(motion_.size());
  for (std::size_t k = 0; k < motion_.size(); ++k) {
    if (!motion_[k]) continue;
    std::vector<char> seen(position_.size(), false);
    std::vector<Vec<dim>> x;
    for (const int f : facets_of_[k])
      for (const int node : mesh_->facets[f])
        if (!seen[node]) seen[node] = true, moved[k].push_back(node), x.push_back(position_[node]);
    velocity[k] = motion_[k](x, t);
    for (std::size_t m = 0; m < x.size(); ++m)
      if (!velocity[k][m].allFinite()) fail("step: the velocity of boundary \"{}\" must be finite, got {} m/s at {}", mesh_->boundary_names[k], place(velocity[k][m]), place(x[m]));
  }
  mesh_velocity_ = mesh_motion == MeshMotion::harmonic ? harmonic(moved, velocity) : stretch(moved, velocity);
  for (std::size_t k = 0; k < position_.size(); ++k) position_[k] = old_position_[k] + dt * mesh_velocity_[k];
  for (const auto& element : mesh_->elements)
    if (!(geometry<dim>(position_, element).volume > 0))
      fail("step: moving the boundaries over {:.4g} s folds the mesh at {} m; take smaller steps, or make a new mesh", dt, place(position_[element[0]]));
}

template class Fluid<2>;  // of the members defined here
template class Fluid<3>;

}  // namespace quicksand::fluid
