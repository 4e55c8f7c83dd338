// Holes of the sampling take the look of the wall around them: the same rule as picture_kernels.close_holes.

uniform sampler2D picture;
uniform sampler2D depths;   // depth, side (negative: starved)
uniform isampler2D nodes;
uniform float focal;

layout(location = 0) out vec4 out_color;
layout(location = 1) out vec2 out_depth;
layout(location = 2) out int out_node;

const float REACH = @HOLE@;
const int LARGEST = @LARGEST_HOLE@;
const int WALLS = @WALLS@;
const int FACES = @FACES@;
const float FACE = @FACE@;

void main() {
    // Rows count from the bottom here.
    ivec2 directions[8] = ivec2[](ivec2(1, 0), ivec2(-1, 0), ivec2(0, -1), ivec2(0, 1),
                                  ivec2(1, -1), ivec2(-1, 1), ivec2(1, 1), ivec2(-1, -1));
    ivec2 here = ivec2(gl_FragCoord.xy);
    ivec2 last = textureSize(depths, 0) - 1;
    float z = texelFetch(depths, here, 0).r;
    ivec2 best = here;
    int nearest = LARGEST + 1;
    int found = 0;
    int level = 0;
    for (int direction = 0;
         direction < 8 && found + 8 - direction >= WALLS && level + 8 - direction >= FACES; ++direction) {
        for (int step = 1; step <= LARGEST; step += step < 4 ? 1 : step / 2) {
            ivec2 there = here + step * directions[direction];
            if (any(lessThan(there, ivec2(0))) || any(greaterThan(there, last)))
                break;
            vec2 wall = texelFetch(depths, there, 0).rg;
            float wide = abs(wall.g);
            if (wall.r < z && float(step) <= max(REACH * wide, 1.0) && wall.r * (1.0 + wide / focal) < z) {
                ++found;
                int ahead = max(int(FACE * wide + 0.5), 1);
                ivec2 beyond = there + ahead * directions[direction];
                float slope = 0.0;
                if (all(greaterThanEqual(beyond, ivec2(0))) && all(lessThanEqual(beyond, last))) {
                    float depth = texelFetch(depths, beyond, 0).r;
                    slope = depth < @EMPTY@ ? (depth / wall.r - 1.0) * focal / float(ahead) : 0.0;
                }
                vec2 along = vec2(directions[direction]);
                float away = float(step * step) * (dot(along, along) + slope * slope);
                if (step == 1 || away <= REACH * wide * REACH * wide) {
                    ++level;
                    if (step < nearest) {
                        nearest = step;
                        best = there;
                    }
                }
                break;
            }
        }
    }
    if (found < WALLS || level < FACES)
        best = here;
    out_color = texelFetch(picture, best, 0);
    out_depth = texelFetch(depths, best, 0).rg;
    out_node = texelFetch(nodes, best, 0).r;
}
