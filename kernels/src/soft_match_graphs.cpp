#include "tensor_stereo/soft_match_graphs.hpp"

#include <algorithm>
#include <array>
#include <vector>

#include "segment_graph.hpp"
#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/index.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

// Calls visit(i, j, critical) for the edges of the exact graph and for the links of their critical points that cross
// them, and visit(i, j, nullptr) for links whose critical points must be searched, among them the chords of co-circular
// polygons.
class LinkCollector {
   public:
    static constexpr std::size_t kMostCorners = 16;  // the chords of larger polygons are not listed: there are too many

    template <class Visit>
    void collect(const Triangulation& mesh, const GraphEdges& edges, const CriticalPoints& points, const Visit& visit) {
        const Index* const vertex = mesh.vertex.data();
        if (mesh.is_collinear) {
            for (std::size_t k = 0; k + 1 < mesh.vertex.size(); ++k) visit(vertex[k], vertex[k + 1], nullptr);
            return;
        }
        const auto half_edges = static_cast<Index>(mesh.origin.size());
        bool any_tie = false;
        for (Index h = 0; h < half_edges; ++h) {
            if (edges.state(h) == GraphEdges::kTie) {
                any_tie = true;
                continue;
            }
            if (mesh.twin[h] > h) continue;  // seen from the other side
            const Critical found = points.of_half_edge(h);
            const Critical near = points.in_reach(h, found);
            visit(vertex[mesh.origin[h]], vertex[mesh.origin[next_in_triangle(h)]], &near);
            if (mesh.twin[h] == kNone || !points.cross(h, found)) continue;
            Critical across;
            visit(found.right, found.left, points.across(h, across) ? &across : nullptr);
        }
        if (any_tie) chords(mesh, edges, visit);
    }

   private:
    template <class Visit>
    void chords(const Triangulation& mesh, const GraphEdges& edges, const Visit& visit) {
        const auto triangles = static_cast<Index>(mesh.origin.size() / 3);
        seen_.assign(triangles, false);
        for (Index t = 0; t < triangles; ++t) {
            if (seen_[t]) continue;
            polygon_.clear();
            stack_.assign(1, t);
            seen_[t] = true;
            while (!stack_.empty()) {
                const Index u = stack_.back();
                stack_.pop_back();
                for (Index h = 3 * u; h < 3 * u + 3; ++h) {
                    polygon_.push_back(mesh.vertex[mesh.origin[h]]);
                    if (edges.state(h) != GraphEdges::kTie || seen_[mesh.twin[h] / 3]) continue;
                    seen_[mesh.twin[h] / 3] = true;
                    stack_.push_back(mesh.twin[h] / 3);
                }
            }
            if (polygon_.size() == 3) continue;
            std::sort(polygon_.begin(), polygon_.end());
            polygon_.erase(std::unique(polygon_.begin(), polygon_.end()), polygon_.end());
            if (polygon_.size() > kMostCorners) continue;
            for (std::size_t a = 0; a < polygon_.size(); ++a) {
                for (std::size_t b = a + 1; b < polygon_.size(); ++b) visit(polygon_[a], polygon_[b], nullptr);
            }
        }
    }

    std::vector<bool> seen_;
    std::vector<Index> polygon_, stack_;
};

struct FoundLink {
    Index i, j;
    Critical view[2];
};

// Both views of one segment after the other.
class LinkFinder {
   public:
    LinkFinder(const double* points0, const double* points1, double tie_tolerance, Reach reach)
        : graph_{SegmentGraph(points0, tie_tolerance), SegmentGraph(points1, tie_tolerance)},
          critical_{CriticalPoints(reach), CriticalPoints(reach)} {}

    void build(const std::int64_t* index, std::size_t count, const std::array<Index*, 2>& degree,
               const std::array<Index*, 2>& neighbors, std::vector<FoundLink>& found) {
        found.clear();
        if (count == 0) return;
        first_.assign(count + 1, 0);
        links_.clear();
        for (int v = 0; v < 2; ++v) {
            graph_[v].build(index, count, degree[v], neighbors[v]);
            critical_[v].prepare(graph_[v].mesh(), graph_[v].edges());
            const auto add = [this, v](Index i, Index j, const Critical* known) {
                const Critical found = known != nullptr ? *known : Critical{kUnknown, kUnknown, false};
                links_.push_back(i < j ? CollectedLink{i, j, v, found} : CollectedLink{j, i, v, found.reversed()});
                ++first_[links_.back().i + 1];
            };
            collector_.collect(graph_[v].mesh(), graph_[v].edges(), critical_[v], add);
        }
        for (std::size_t i = 0; i < count; ++i) first_[i + 1] += first_[i];
        sorted_.resize(links_.size());
        position_.assign(first_.begin(), first_.end() - 1);
        for (const CollectedLink& link : links_) sorted_[position_[link.i]++] = link;
        for (std::size_t i = 0; i < count; ++i) {
            const auto begin = sorted_.begin() + first_[i], end = sorted_.begin() + first_[i + 1];
            std::sort(begin, end, [](const CollectedLink& a, const CollectedLink& b) { return a.j < b.j; });
            for (auto k = begin; k != end;) {
                FoundLink link{k->i, k->j, {{kUnknown, kUnknown, false}, {kUnknown, kUnknown, false}}};
                for (; k != end && k->j == link.j; ++k) {
                    if (k->critical.left != kUnknown) link.view[k->view] = k->critical;
                }
                for (int v = 0; v < 2; ++v) {
                    if (link.view[v].left == kUnknown) link.view[v] = critical_[v].find(link.i, link.j);
                }
                found.push_back(link);
            }
        }
    }

   private:
    static constexpr Index kUnknown = -3;

    struct CollectedLink {
        Index i, j;  // i < j
        int view;
        Critical critical;
    };

    SegmentGraph graph_[2];
    CriticalPoints critical_[2];
    LinkCollector collector_;
    std::vector<CollectedLink> links_, sorted_;
    std::vector<Index> first_, position_;
};

}  // namespace

SoftMatchGraphs soft_match_graphs(const double* points0, const double* points1, std::int64_t num_points,
                                  const std::int64_t* index, const std::int64_t* ptr, std::int64_t num_segments,
                                  double tie_tolerance, Reach reach, int num_threads) {
    const SegmentRows rows[2] = {SegmentRows(ptr[num_segments]), SegmentRows(ptr[num_segments])};
    std::vector<std::vector<FoundLink>> found(num_segments);
    parallel_for(num_segments, 1, num_threads, [&] {
        return [&, finder = LinkFinder(points0, points1, tie_tolerance, reach), buffer = std::vector<FoundLink>()](
                   std::int64_t begin, std::int64_t end) mutable {
            for (std::int64_t s = begin; s < end; ++s) {
                const std::int64_t start = ptr[s];
                finder.build(index + start, static_cast<std::size_t>(ptr[s + 1] - start),
                             {rows[0].degree.get() + start, rows[1].degree.get() + start},
                             {rows[0].neighbors.get() + 6 * start, rows[1].neighbors.get() + 6 * start}, buffer);
                found[s] = buffer;
            }
        };
    });
    SoftMatchGraphs result;
    for (int v = 0; v < 2; ++v) {
        result.graph[v] = assemble(rows[v], num_points, index, ptr, num_segments, num_threads);
    }
    result.link_ptr = allocate<std::int64_t>(num_segments + 1);
    std::int64_t* const offset = result.link_ptr.get();
    offset[0] = 0;
    for (std::int64_t s = 0; s < num_segments; ++s) {
        offset[s + 1] = offset[s] + static_cast<std::int64_t>(found[s].size());
    }
    result.num_links = offset[num_segments];
    result.links = allocate<std::int64_t>(2 * result.num_links);
    for (auto& view : result.view) {
        view.critical = allocate<std::int64_t>(2 * result.num_links);
        view.is_edge = allocate<bool>(result.num_links);
    }
    parallel_for(num_segments, 1, num_threads, [&] {
        return [&](std::int64_t begin, std::int64_t end) {
            for (std::int64_t s = begin; s < end; ++s) {
                const std::int64_t* const members = index + ptr[s];
                std::int64_t k = offset[s];
                for (const FoundLink& link : found[s]) {
                    result.links[2 * k] = members[link.i];
                    result.links[2 * k + 1] = members[link.j];
                    for (int v = 0; v < 2; ++v) {
                        result.view[v].critical[2 * k] = to_row(members, link.view[v].right);
                        result.view[v].critical[2 * k + 1] = to_row(members, link.view[v].left);
                        result.view[v].is_edge[k] = link.view[v].is_edge;
                    }
                    ++k;
                }
            }
        };
    });
    return result;
}

}  // namespace tensor_stereo
