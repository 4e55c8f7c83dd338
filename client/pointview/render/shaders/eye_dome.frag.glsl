// Eye-dome lighting: see shading.py for the formula.

uniform sampler2D picture;
uniform sampler2D depths;   // depth, side (negative: starved)
uniform float strength;     // times the focal length

layout(location = 0) out vec4 out_color;

const float NEIGHBOUR = @NEIGHBOUR@;
const float DARKEST = @DARKEST@;

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    ivec2 last = textureSize(depths, 0) - 1;
    vec4 color = texelFetch(picture, here, 0);
    vec2 seen = texelFetch(depths, here, 0).rg;
    if (seen.r >= @EMPTY@) {
        out_color = color;
        return;
    }
    int away = max(int(abs(seen.g) * NEIGHBOUR + 0.5), 1);
    float product = 1.0;
    for (int y = -1; y <= 1; ++y)
        for (int x = -1; x <= 1; ++x) {
            ivec2 there = here + away * ivec2(x, y);
            if (any(lessThan(there, ivec2(0))) || any(greaterThan(there, last)))
                continue;
            float ratio = texelFetch(depths, there, 0).r / seen.r;
            if (ratio < 1.0)
                product *= max(ratio, 1e-4);
        }
    float shade = exp(strength / (8.0 * float(away)) * log(product));
    out_color = vec4(color.rgb * (DARKEST + (1.0 - DARKEST) * shade), color.a);
}
