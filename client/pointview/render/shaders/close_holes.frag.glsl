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
    for (int direction = 0; direction < 8 && found + 8 - direction >= WALLS; ++direction) {
        for (int step = 1; step <= LARGEST; step += step < 4 ? 1 : step / 2) {
            ivec2 there = here + step * directions[direction];
            if (any(lessThan(there, ivec2(0))) || any(greaterThan(there, last)))
                break;
            vec2 wall = texelFetch(depths, there, 0).rg;
            float wide = abs(wall.g);
            if (wall.r < z && float(step) <= max(REACH * wide, 1.0) && wall.r * (1.0 + wide / focal) < z) {
                ++found;
                if (step < nearest) {
                    nearest = step;
                    best = there;
                }
                break;
            }
        }
    }
    if (found < WALLS)
        best = here;
    out_color = texelFetch(picture, best, 0);
    out_depth = texelFetch(depths, best, 0).rg;
    out_node = texelFetch(nodes, best, 0).r;
}
