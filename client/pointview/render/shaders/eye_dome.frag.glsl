// Eye-dome lighting: see shading.py for the formula.

uniform sampler2D picture;
uniform sampler2D depths;   // infinite where empty
uniform float factor;       // strength * focal / (8 * radius)

layout(location = 0) out vec4 out_color;

const int RADIUS = @RADIUS@;

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    ivec2 last = textureSize(depths, 0) - 1;
    vec4 color = texelFetch(picture, here, 0);
    float z = texelFetch(depths, here, 0).r;
    if (z >= @EMPTY@) {
        out_color = color;
        return;
    }
    float product = 1.0;
    for (int y = -RADIUS; y <= RADIUS; y += RADIUS)
        for (int x = -RADIUS; x <= RADIUS; x += RADIUS) {
            ivec2 there = here + ivec2(x, y);
            if (any(lessThan(there, ivec2(0))) || any(greaterThan(there, last)))
                continue;
            float ratio = texelFetch(depths, there, 0).r / z;
            if (ratio < 1.0)
                product *= max(ratio, 1e-4);
        }
    out_color = vec4(color.rgb * exp(factor * log(product)), color.a);
}
