// A pixel of a blended sample's kernel: see blend_kernels.gather.

flat in vec3 linear;     // its light
flat in vec3 center;
flat in vec2 middle;
flat in vec3 plane;
flat in vec3 form;        // of the exponent: xx, yy, xy
flat in float share;
flat in float farthest;   // how far behind what is seen it still counts

uniform sampler2D depths; // depth, side
uniform vec2 size;
uniform float focal;

layout(location = 0) out vec4 sums;

const float MOST = @KERNEL_ENDS@ * @KERNEL_ENDS@;

void main() {
    float depth = texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r;
    vec2 d = gl_FragCoord.xy - middle;
    vec3 ray = vec3((gl_FragCoord.xy - 0.5 * size) / focal, 1.0);
    float ratio = dot(plane, center) / (center.z * dot(plane, ray));
    float q = abs(ratio * ratio * (form.x * d.x * d.x + form.y * d.y * d.y + 2.0 * form.z * d.x * d.y));
    if (!(q <= MOST && ratio > 0.0 && ratio * center.z <= depth + farthest && depth < @EMPTY@))
        discard;
    sums = share * exp(-0.5 * q) * vec4(linear, 1.0);
}
