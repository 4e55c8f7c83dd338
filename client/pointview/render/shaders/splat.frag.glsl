// A pixel of a splat: the same pixels as on the CPU, whatever the driver makes of a point's size.

flat in vec3 rgb;
flat in vec2 middle;
flat in vec2 reach;
flat in float depth;
flat in int seen;

layout(location = 0) out vec4 out_color;
layout(location = 1) out float out_depth;
layout(location = 2) out int out_node;

void main() {
    if (reach.x > 0.0) {
        vec2 d = gl_FragCoord.xy - middle;
        if (reach.y > 0.5 ? dot(d, d) > reach.x * reach.x : max(abs(d.x), abs(d.y)) > reach.x)
            discard;
    }
    out_color = vec4(rgb, 1.0);
    out_depth = depth;
    out_node = seen;
}
