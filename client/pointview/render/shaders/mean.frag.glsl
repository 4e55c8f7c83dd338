// The mean of blended samples as a colour; pixels that none reaches keep theirs.

uniform sampler2D picture;
uniform sampler2D sums;

layout(location = 0) out vec4 out_color;

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    vec4 sum = texelFetch(sums, here, 0);
    out_color = texelFetch(picture, here, 0);
    if (sum.a > @LEAST@) {
        vec3 light = sum.rgb / sum.a;
        out_color.rgb = mix(1.055 * pow(light, vec3(1.0 / 2.4)) - 0.055, 12.92 * light, lessThanEqual(light, vec3(0.0031308)));
    }
}
