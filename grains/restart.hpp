// How far accelerated sweeps extrapolate, and when they start over: the same for scenes and for problems written out.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

namespace quicksand {

// Nesterov's extrapolation of an iteration p -> p', by beta times the way since the last step (Soviet Math. Dokl. 27 (1983)), and when it
// starts over from beta = 0: where the iteration pulls back against that way (B. O'Donoghue and E. Candes, Found. Comput. Math. 15 (2015)),
// and where its own changes grow. Friction is no gradient of anything: pushed on by its momentum alone the iteration can circle without
// ever being pulled back. Of factors 1, 1.2 and 2 the one with the fewest sweeps; without it one dense state of two circled at 3e-3.
class Restart {
 public:
  // beta for the step after one that changed p by so much.
  double weigh(double change) {
    grown_ = change > 1.2 * least_;
    least_ = std::min(least_, change);
    const double next = 0.5 * (1 + std::sqrt(1 + 4 * t_ * t_)), beta = (t_ - 1) / next;
    t_ = next;
    return beta;
  }
  // To be told before the next step.
  void resisted(bool pulled_back) {
    if (pulled_back || grown_) t_ = 1.0, least_ = std::numeric_limits<double>::infinity();
  }

 private:
  double t_ = 1.0, least_ = std::numeric_limits<double>::infinity();
  bool grown_ = false;
};

}  // namespace quicksand
