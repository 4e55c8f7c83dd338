// A pixel of a splat: the same pixels and depths as on the CPU, whatever the driver makes of a point's size.

flat in vec3 rgb;
flat in vec3 center;
flat in vec2 middle;
flat in vec3 plane;
flat in float extent;
flat in float side;
flat in int kind;
flat in int seen;

uniform vec2 size;
uniform float focal;
uniform vec2 range;
uniform float bulge;

layout(location = 0) out vec4 out_color;
layout(location = 1) out vec2 out_depth;   // depth; side of the splat, pixels, negative where starved
layout(location = 2) out int out_node;

void main() {
    float depth = center.z;
    float behind = 0.0;
    vec2 d = gl_FragCoord.xy - middle;
    if (kind == SQUARE) {
        if (max(abs(d.x), abs(d.y)) > extent)
            discard;
    } else if (kind == BALL) {
        if (dot(d, d) > extent * extent)
            discard;
        behind = bulge * depth / (focal * extent) * dot(d, d);
    } else if (kind == DISC) {
        vec3 ray = vec3((gl_FragCoord.xy - 0.5 * size) / focal, 1.0);
        float t = dot(plane, center) / dot(plane, ray);
        vec3 apart = t * ray - center;
        if (!(t > 0.0 && dot(apart, apart) <= extent * extent))
            discard;
        depth = t;
        behind = bulge / extent * dot(apart, apart);
    }
    out_color = vec4(rgb, 1.0);
    out_depth = vec2(depth, side);
    out_node = seen;
    // The logarithm keeps the same relative precision at every depth.
    gl_FragDepth = log((depth + behind) / range.x) / log(range.y / range.x);
}
