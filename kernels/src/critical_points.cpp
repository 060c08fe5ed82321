#include "tensor_stereo/critical_points.hpp"

#include <cmath>
#include <cstdlib>
#include <limits>

namespace tensor_stereo {

void CriticalPoints::prepare(const Triangulation& mesh, const GraphEdges& edges) {
    mesh_ = &mesh;
    edges_ = &edges;
    has_search_ = false;
    const auto count = static_cast<Index>(mesh.vertex.size());
    rank_.resize(count);
    for (Index v = 0; v < count; ++v) rank_[mesh.vertex[v]] = v;
    if (mesh.is_collinear) return;
    fan_.resize(count);
    degree_.assign(count, 0);
    const auto half_edges = static_cast<Index>(mesh.origin.size());
    for (Index h = 0; h < half_edges; ++h) {
        fan_[mesh.origin[h]] = h;
        ++degree_[mesh.origin[h]];
    }
    for (Index h = 0; h < half_edges; ++h) {
        if (mesh.twin[h] == kNone) fan_[mesh.origin[h]] = h;
    }
}

Critical CriticalPoints::find(Index i, Index j) {
    const Index a = rank_[i], b = rank_[j];
    if (mesh_->is_collinear) {  // numbered along the line
        const bool is_edge = std::abs(a - b) == 1;
        return {is_edge ? kNone : kBlocked, is_edge ? kNone : kBlocked, is_edge};
    }
    return degree_[a] <= degree_[b] ? find_in_mesh(a, b) : find_in_mesh(b, a).reversed();
}

Critical CriticalPoints::to_input(Critical found) const noexcept {
    if (found.right >= 0) found.right = mesh_->vertex[found.right];
    if (found.left >= 0) found.left = mesh_->vertex[found.left];
    return found;
}

bool CriticalPoints::cross(Index h, const Critical& found) const noexcept {
    const Index i = mesh_->origin[h], j = mesh_->origin[next_in_triangle(h)];
    const Index k = rank_[found.right], l = rank_[found.left];
    return turn(k, l, i) > 0 && turn(k, l, j) < 0;
}

bool CriticalPoints::across(Index h, Critical& found) const noexcept {
    const Index* const origin = mesh_->origin.data();
    const Index twin = mesh_->twin[h];
    const Index sides[4] = {previous_in_triangle(h), next_in_triangle(twin), next_in_triangle(h),
                            previous_in_triangle(twin)};
    const Index i = origin[h], j = origin[twin], k = origin[sides[3]], l = origin[sides[0]];
    const Point* const p = mesh_->points.data();
    for (int side = 0; side < 4; ++side) {
        if (edges_->state(sides[side]) == GraphEdges::kTie) return false;
        const Index beyond = mesh_->twin[sides[side]];
        if (beyond == kNone) continue;
        const Point q = p[origin[previous_in_triangle(beyond)]];
        const int inside =
            side < 2 ? incircle(p[k], p[l], p[i], q, mesh_->bounds) : incircle(p[l], p[k], p[j], q, mesh_->bounds);
        if (inside == 0) return false;
    }
    found = {mesh_->vertex[j], mesh_->vertex[i], false};
    if (is_out_of_reach(k, l, j, i)) found = kBlockedLink;
    return true;
}

Critical CriticalPoints::find_in_mesh(Index i, Index j) {
    const Index* const origin = mesh_->origin.data();
    const Index* const twin = mesh_->twin.data();
    const Point p = mesh_->points[i], q = mesh_->points[j];
    const auto is_ahead = [&](Index v) {
        const Point r = mesh_->points[v];
        return p.x == q.x ? (r.y > p.y) == (q.y > p.y) : (r.x > p.x) == (q.x > p.x);
    };
    const Index first = fan_[i], first_end = origin[next_in_triangle(first)];
    int right = turn(i, first_end, j);
    if (right == 0 && first_end == j) return in_reach(first, of_half_edge(first));
    if (right == 0 && is_ahead(first_end)) return kBlockedLink;
    for (Index h = first;;) {
        const Index back = previous_in_triangle(h), end = origin[back];
        const int left = turn(i, end, j);
        if (left == 0 && end == j) return in_reach(back, of_half_edge(back)).reversed();
        if (left == 0 && is_ahead(end)) return kBlockedLink;
        if (right > 0 && left < 0) return to_input(walk(i, j, h));
        right = left;
        h = twin[back];
        if (h == kNone) return kBlockedLink;  // not in a triangulation
    }
}

// The link is half-edge h.
Critical CriticalPoints::between(Index h) const {
    const auto side = [this](Index g) {
        return g == kNone ? kNone : first_of_polygon(g, mesh_->origin[previous_in_triangle(g)]);
    };
    return {side(mesh_->twin[h]), side(h), edges_->state(h) == GraphEdges::kLong};
}

Critical CriticalPoints::in_reach(Index h, Critical found) const noexcept {
    if (found.right == kNone || found.left == kNone) return found;
    const Index i = mesh_->origin[h], j = mesh_->origin[next_in_triangle(h)];
    if (is_out_of_reach(i, j, rank_[found.right], rank_[found.left])) return {kBlocked, kBlocked, found.is_edge};
    return found;
}

// From i through the triangle of h, whose inside the segment enters, to j.
Critical CriticalPoints::walk(Index i, Index j, Index h) {
    const Index* const origin = mesh_->origin.data();
    const Index* const twin = mesh_->twin.data();
    const Point p = mesh_->points[i], q = mesh_->points[j];
    const double dx = q.x - p.x, dy = q.y - p.y, span = std::fabs(dx) + std::fabs(dy);
    const double out_of_reach = -(1 + 1e-9) * reach(i, j);  // beyond doubt
    double cross = 0;
    // The end of the dual towards k; leaves the cross product of the vectors to j and to k in cross.
    const auto look = [&](Index k) -> End {
        const double x = mesh_->points[k].x - p.x, y = mesh_->points[k].y - p.y;
        cross = dx * y - dy * x;
        const double inverse = 1 / std::fabs(cross), value = 0.5 * inverse * (x * (x - dx) + y * (y - dy));
        const double size = std::fabs(x) + std::fabs(y);
        return {value, 1.1e-15 * inverse * size * (size + (1 + 2 * std::fabs(value)) * span)};
    };
    const Index first_right = origin[next_in_triangle(h)], first_left = origin[previous_in_triangle(h)];
    chains_[kRight].start(first_right, twin[h], look(first_right));
    chains_[kLeft].start(first_left, twin[previous_in_triangle(h)], look(first_left));
    h = twin[next_in_triangle(h)];
    for (Index steps = 0;; ++steps) {  // the segment enters a triangle through h, from the left chain to the right one
        if (chains_[kLeft].best_end.above() + chains_[kRight].best_end.above() < out_of_reach) return kBlockedLink;
        if (steps == max_steps_) return search(i, j);
        const Index sides[2] = {next_in_triangle(h), previous_in_triangle(h)};  // to the right, to the left
        const Index apex = origin[sides[kLeft]];
        if (apex == j) {
            for (int side = 0; side < 2; ++side) chains_[side].push(j, twin[sides[side]]);
            break;
        }
        const End end = look(apex);
        int turned = sign(cross);
        if (std::fabs(cross) <= mesh_->bounds.orientation) turned = turn(i, j, apex);
        if (turned == 0) return kBlockedLink;
        // Which side it is, is as good as random: no branch depends on it.
        const int side = turned > 0 ? kLeft : kRight;
        Chain& chain = chains_[side];
        const double gain = chain.best_end.value - end.value;
        int inside = sign(gain);
        if (!(std::fabs(gain) > chain.best_end.error + end.error)) inside = is_inside(side, i, j, chain, apex);
        chain.best = inside > 0 ? chain.size : chain.best;
        chain.best_end.value = inside > 0 ? end.value : chain.best_end.value;
        chain.best_end.error = inside > 0 ? end.error : chain.best_end.error;
        chain.any_tie = inside > 0 ? false : (inside == 0) | chain.any_tie;
        chain.push(apex, twin[sides[side]]);
        h = twin[sides[1 - side]];
    }
    const Critical found{first_of_best(j, i, chains_[kRight]), first_of_best(i, j, chains_[kLeft]), false};
    return is_out_of_reach(i, j, found.right, found.left) ? kBlockedLink : found;
}

// The sign of how far a vertex lies inside the circle of the best on its side; rounding decides nothing.
int CriticalPoints::is_inside(int side, Index i, Index j, const Chain& chain, Index vertex) const noexcept {
    const Point* const p = mesh_->points.data();
    const Index best = chain.corners[chain.best].vertex;
    return side == kLeft ? incircle(p[i], p[j], p[best], p[vertex], mesh_->bounds)
                         : incircle(p[j], p[i], p[best], p[vertex], mesh_->bounds);
}

// The same by a search among all points.
Critical CriticalPoints::search(Index i, Index j) {
    if (!has_search_) search_.build(mesh_->points, mesh_->bounds);
    has_search_ = true;
    const Point* const p = mesh_->points.data();
    const Index left = search_.find_left(i, j, -std::numeric_limits<double>::infinity());
    if (left == kBlocked) return kBlockedLink;
    double enough = -std::numeric_limits<double>::infinity();
    if (left != kNone) {
        const double end = dual_end(p[i], p[j], p[left]), error = end - least_dual_end(p[i], p[j], p[left]);
        enough = -(1 + 1e-9) * reach(i, j) - (end + error);
    }
    const Critical found{search_.find_left(j, i, enough), left, false};
    if (found.right == kBlocked) return kBlockedLink;
    if (found.left == kNone || found.right == kNone) return found;
    return is_out_of_reach(i, j, found.right, found.left) ? kBlockedLink : found;
}

// Of the best vertices of a chain on the left of i -> j, and of all others on their circle, the first.
Index CriticalPoints::first_of_best(Index i, Index j, const Chain& chain) const {
    const Point* const p = mesh_->points.data();
    const Index last = chain.size - 1;  // an end of the segment
    const Index apex = chain.corners[chain.best].vertex;
    const auto is_on_circle = [&](Index v) { return incircle(p[i], p[j], p[apex], p[v], mesh_->bounds) == 0; };
    Index first = apex;
    bool before_on_circle = true;  // the other end of the segment
    for (Index k = 0; k <= last; ++k) {
        const auto [v, beyond] = chain.corners[k];
        const bool on_circle = k == chain.best || k == last || (chain.any_tie && is_on_circle(v));
        if (on_circle && k != last && is_before(v, first)) first = v;
        if (on_circle && before_on_circle && beyond != kNone &&
            is_on_circle(mesh_->origin[previous_in_triangle(beyond)])) {
            first = first_of_polygon(beyond, first);
        }
        before_on_circle = on_circle;
    }
    return first;
}

// The first of a vertex and those of a co-circular polygon on the inner side of its half-edge h.
Index CriticalPoints::first_of_polygon(Index h, Index first) const {
    const Index apex = mesh_->origin[previous_in_triangle(h)];
    if (is_before(apex, first)) first = apex;
    for (const Index side : {next_in_triangle(h), previous_in_triangle(h)}) {
        if (edges_->state(side) == GraphEdges::kTie) first = first_of_polygon(mesh_->twin[side], first);
    }
    return first;
}

// Whether the dual of {i, j} may be too negative, always computed from the vertex that comes first in the input.
bool CriticalPoints::is_out_of_reach(Index i, Index j, Index right, Index left) const noexcept {
    if (mesh_->vertex[i] > mesh_->vertex[j]) return is_out_of_reach(j, i, left, right);
    const double limit = reach(i, j);
    const Point* const p = mesh_->points.data();
    return !std::isinf(limit) &&
           !(least_dual_end(p[i], p[j], p[left]) + least_dual_end(p[i], p[j], p[right]) >= -limit);
}

bool CriticalPoints::is_before(Index v, Index w) const noexcept {
    const Point p = mesh_->points[v], q = mesh_->points[w];
    return p.x < q.x || (p.x == q.x && p.y < q.y);
}

}  // namespace tensor_stereo
